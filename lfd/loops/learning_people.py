"""What people at the wheel are after, from recordings of `lfd interact`: maximum entropy over their choices."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lfd.core.artifact import check_output, sha256
from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Progress, silent
from lfd.interaction.driving_irl import FEATURES, Choices, choices_of, learn_theta, log_likelihood, together
from lfd.interaction.driving_model import TYPES
from lfd.interaction.person_reward import PersonReward, save_person_reward
from lfd.record.episode_file import read_episode, recordings_in
from lfd.worlds.driving_world import SCENES


@dataclass(frozen=True, kw_only=True)
class PeopleReport:
    """What was learned, and how well it tells what people do who were held out."""

    reward: PersonReward
    converged: bool
    held_out: dict[str, float] | None
    """Mean log-likelihood of a choice [nat]: learned, the type's default weights, chance; None where nobody was."""


def learn_people(
    source: Path,
    kind: str,
    out: Path,
    *,
    holdout: int,
    rationality: float,
    overwrite: bool = False,
    progress: Progress = silent,
) -> PeopleReport:
    """Learn R_H of one type of people from recordings in which all are of it; the last `holdout` only judge.

    Raises `UnknownName` for another type, `InputError` for recordings of other scenes or too few of them.
    """
    if kind not in TYPES:
        raise UnknownName("type of person", kind, TYPES)
    check_output(out, overwrite=overwrite)
    paths = recordings_in([source])
    if not 0 <= holdout < len(paths):
        raise InputError(f"{source} has {len(paths)} recordings, of which --holdout {holdout} leave none: give more")
    parts: list[Choices] = []
    with progress("recordings", len(paths)) as bar:
        for path in paths:
            episode = read_episode(path)
            if episode.metadata.task not in SCENES:
                raise InputError(
                    f"{path} is of {episode.metadata.task}; people's rewards are learned on the road: give recordings "
                    f"of `lfd interact` in {' or '.join(sorted(SCENES))}"
                )
            parts.append(choices_of(SCENES[episode.metadata.task], episode))
            bar.advance()
    seen, rest = together(parts[: len(parts) - holdout]), parts[len(parts) - holdout :]
    found = learn_theta(seen, rationality=rationality)
    reward = PersonReward(
        type=kind,
        features=FEATURES,
        weights=tuple(found.theta.tolist()),
        spread=tuple(np.sqrt(np.diag(found.covariance)).tolist()),
        rationality=rationality,
        choices=len(seen.chosen),
        log_likelihood=log_likelihood(found.theta, seen, rationality)[0] / len(seen.chosen),
    )
    recipe = {"method": "people", "type": kind, "holdout": holdout, "rationality": rationality}
    save_person_reward(reward, out, recipe=recipe, parents={str(source): sha256(source)}, overwrite=overwrite)
    judged = predicted(rest, reward) if rest else None
    return PeopleReport(reward=reward, converged=found.converged, held_out=judged)


def predicted(parts: Sequence[Choices], reward: PersonReward) -> dict[str, float]:
    """Mean log-likelihood of a choice by what was learned, by the default weights of the type, and by chance [nat]."""
    choices = together(parts)
    count = len(choices.chosen)
    weights = {"learned": reward.weights, "default": TYPES[reward.type]}
    found = {
        name: log_likelihood(np.array(theta), choices, reward.rationality)[0] / count for name, theta in weights.items()
    }
    return found | {"chance": -float(np.log(choices.known.shape[1]))}
