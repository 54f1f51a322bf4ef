"""A comparison on disk: begun as a folder that keeps its pool and every answer, ended as a reward.

`pool.json` is what is compared. `comparing.json` has what was known before, the rules and the answers so far, and is
replaced whole after each answer. A person's questions stand beside them as `question_*.rrd` until they have ended; then
the folder of the reward takes this one's place, with both files in it.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lfd.core.artifact import new_folder, read_manifest, write_json, write_manifest
from lfd.core.errors import InputError
from lfd.loops.comparing import Comparison, Rules, answers_of, answers_table
from lfd.loops.comparison_pool import FILE as POOL
from lfd.loops.comparison_pool import load_pool
from lfd.rewards.reward_artifact import LinearReward, reward_of, reward_table, save_reward

STATE = "comparing.json"
KIND = "comparison"


@dataclass
class Folder:
    """Where a comparison is kept."""

    path: Path
    parents: Mapping[str, str]
    """Path of the pool's source, and of the reward that it began with, to the hash."""
    comparison: Comparison
    replies: int = 0
    """Lines of a file that were used up, undone ones among them."""

    def begin(self, *, overwrite: bool) -> None:
        """Make the folder. Raises `OutputError` when it exists."""
        with new_folder(self.path, overwrite=overwrite) as part:
            write_json(part / POOL, self.comparison.pool.table())
            write_json(part / STATE, self._state())
            rules = asdict(self.comparison.rules)
            write_manifest(part, kind=KIND, recipe=rules, parents=self.parents, seed=self.comparison.rules.seed)

    def save(self) -> None:
        """Keep the answers so far."""
        write_json(self.path / STATE, self._state())

    def _state(self) -> dict[str, Any]:
        comparison = self.comparison
        return {
            "begin": reward_table(comparison.begin),
            "rules": asdict(comparison.rules),
            "answers": answers_table(comparison),
            "replies": self.replies,
        }

    def end(self, *, ended: str, also: Mapping[str, bytes]) -> LinearReward:
        """Put the reward after all answers into the folder's place, with what it keeps and `also` other files."""
        comparison = self.comparison
        reward = comparison.reward()
        kept = [self.path / POOL, self.path / STATE]
        save_reward(
            reward,
            self.path,
            recipe=asdict(comparison.rules) | {"questions": len(comparison.answers), "ended": ended},
            parents=self.parents,
            seed=comparison.rules.seed,
            overwrite=True,
            also={file.name: file.read_bytes() for file in kept} | dict(also),
        )
        return reward


def resumed(path: Path) -> Folder:
    """The comparison in a folder, as far as it went.

    Raises `InputError` when there is none, or what it keeps is damaged.
    """
    file = path / STATE
    if not file.is_file():
        raise InputError(f"{path} holds no {STATE}: there is nothing to resume; leave out --resume")
    pool = load_pool(path)
    try:
        state = json.loads(file.read_text(encoding="utf-8"))
        begin = reward_of(state["begin"], f"{file}, begin")
        comparison = Comparison(pool, begin, Rules(**state["rules"]), answers_of(state["answers"], pool, str(file)))
        replies = int(state["replies"])
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{file} is no state of a comparison ({error!r}); compare again") from error
    return Folder(path, (read_manifest(path) or {}).get("parents", {}), comparison, replies)
