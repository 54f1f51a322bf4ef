"""What people are after, from recordings of `lfd interact`: maximum entropy over their choices."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lfd.core.artifact import check_output, sha256
from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Progress, silent
from lfd.interaction.choices_irl import Person, learn_theta, of_people
from lfd.interaction.person_reward import LEARNABLE, PersonReward, save_person_reward
from lfd.interaction.scenes import SCENES
from lfd.record.episode_file import read_episode, recordings_in


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
    if kind not in LEARNABLE:
        raise UnknownName("type of person", kind, LEARNABLE)
    check_output(out, overwrite=overwrite)
    paths = recordings_in([source])
    if not 0 <= holdout < len(paths):
        raise InputError(f"{source} has {len(paths)} recordings, of which --holdout {holdout} leave none: give more")
    people: list[Person] = []
    with progress("recordings", len(paths)) as bar:
        for path in paths:
            episode = read_episode(path)
            places = [name for name, scene in SCENES.items() if kind in scene.learnable]
            if episode.metadata.task not in places:
                raise InputError(
                    f"{path} is of {episode.metadata.task}, where nobody is {kind}: give recordings of `lfd interact` "
                    f"in {' or '.join(places)}"
                )
            people.append(SCENES[episode.metadata.task].choices(episode))
            bar.advance()
    seen, rest = people[: len(people) - holdout], people[len(people) - holdout :]
    found, count = learn_theta(seen, wide=np.array(LEARNABLE[kind].wide), rationality=rationality), choices_in(seen)
    reward = PersonReward(
        type=kind,
        features=LEARNABLE[kind].features,
        weights=tuple(found.theta.tolist()),
        spread=tuple(np.sqrt(np.diag(found.covariance)).tolist()),
        rationality=rationality,
        choices=count,
        log_likelihood=of_people(found.theta, seen, rationality)[0] / count,
    )
    recipe = {"method": "people", "type": kind, "holdout": holdout, "rationality": rationality}
    save_person_reward(reward, out, recipe=recipe, parents={str(source): sha256(source)}, overwrite=overwrite)
    judged = predicted(rest, reward) if rest else None
    return PeopleReport(reward=reward, converged=found.converged, held_out=judged)


def predicted(people: Sequence[Person], reward: PersonReward) -> dict[str, float]:
    """Mean log-likelihood of a choice by what was learned, by the default weights of the type, and by chance [nat]."""
    count, weights = choices_in(people), {"learned": reward.weights, "default": LEARNABLE[reward.type].default}
    found = {name: of_people(np.array(theta), people, reward.rationality)[0] / count for name, theta in weights.items()}
    return found | {"chance": -float(np.log(people[0][0].known.shape[1]))}


def choices_in(people: Sequence[Person]) -> int:
    """How many choices were made."""
    return sum(len(person[0].chosen) for person in people)
