"""A trained policy in a person's care: they watch it, take over, hand back; what results is recorded.

The recordings tell in which steps the person acted, and carry their actions as labels, as those of a round of DAgger do
(`lfd.loops.dagger_person`): `lfd convert` adds them to a dataset, on which `lfd train --init` goes on.
"""

from dataclasses import replace
from pathlib import Path

from lfd.core.artifact import read_manifest
from lfd.core.errors import OutputError
from lfd.core.protocols import Observer, Progress, silent
from lfd.core.recipe import build
from lfd.loops.dagger_person import Person
from lfd.policies.acting import AskedOnce
from lfd.record.demonstrations import EPISODE, begin_recordings, numbers_in
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.mcap_file import SUFFIX
from lfd.record.session import Session
from lfd.run.trial import EvalRecipe, Trial
from lfd.worlds.robosuite_world import make_worlds
from lfd.worlds.rollout import episode_rng

STAGE = "watch"
REST_S = 0.5
"""Rest of the device after which control goes back to the policy [s]."""


def trial_of(policy: Path, robot: str | None, *, longest_s: float) -> Trial:
    """The policy as it was evaluated, on a robot (none: its own), for `longest_s` [s] a rollout.

    Raises `PolicyError` for a folder that is no policy, or made for another robot.
    """
    trial = Trial.of(policy, EvalRecipe(episodes=1, seed=0, max_seconds=longest_s, hold_seconds=0.5), robot=robot)
    known = trial.about["recipe"].get("eval")
    if known is None:
        return trial
    return replace(trial, recipe=replace(build(EvalRecipe, known, f"{policy} [eval]"), max_seconds=longest_s))


def watch(trial: Trial, out: Path, person: Person, *, rollouts: int, progress: Progress = silent) -> Session:
    """Rollouts of a policy in a person's care, added to the recordings in `out`; fewer when the person quits.

    Raises `OutputError` when `out` holds something else, and `PolicyError` for a policy that does not fit.
    """
    about, recipe = trial.about, trial.recipe
    manifest = read_manifest(out) if out.is_dir() else None
    if manifest is None:
        if out.exists():
            raise OutputError(f"{out} is there and holds no recordings; choose another name")
        begin_recordings(out, trial.used, recipe.seed)
    elif manifest.get("kind") != "recordings":
        raise OutputError(f"{out} holds a {manifest.get('kind')}; choose another name")
    (world,) = make_worlds(about["task"], trial.robot, about["control_hz"], most=1, progress=progress)
    learned = AskedOnce(trial.learned([world]))

    def recorder(number: int) -> Observer:
        origin = Origin(stage=STAGE, policy=about["policy"], seed=recipe.seed, index=number, recipe=trial.used)
        return McapRecorder(out / f"{EPISODE}{number:06d}{SUFFIX}", origin, keep_failures=True)

    return person.look_after(
        [learned],
        world,
        lambda number: episode_rng(STAGE, recipe.seed, number),
        recorder,
        first=max(numbers_in(out, "$"), default=-1) + 1,
        wanted=rollouts,
        horizon=round(recipe.max_seconds * about["control_hz"]),
        hold_steps=max(1, round(recipe.hold_seconds * about["control_hz"])),
        rest_seconds=REST_S,
        longer="a longer rollout",
    )
