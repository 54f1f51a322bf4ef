"""One round of DAgger: roll out, aggregate, retrain, measure.

Each stage leaves an artifact in the round's folder and takes it from there when it is there already; `report.json`
comes last. A round that was killed therefore goes on where it was, and ends as if nothing had happened.
"""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfd.convert.to_lerobot import convert
from lfd.core.artifact import heal, read_manifest, sha256, write_json
from lfd.core.errors import InputError
from lfd.core.protocols import BatchPolicy, Decision, Observers, Progress, unwatched
from lfd.experts.registry import make_expert
from lfd.loops.dagger_control import learner_of, who_acts
from lfd.loops.dagger_person import QUIT, Person
from lfd.loops.dagger_recipe import LoopRecipes
from lfd.record.demonstrations import EPISODE, begin_recordings, numbers_in, record, take_cameras
from lfd.record.episode_file import McapRecorder, Origin, episode_of
from lfd.record.mcap_file import SUFFIX, read_mcap
from lfd.run.gates import Counts
from lfd.run.judging import STAGE as JUDGE
from lfd.run.judging import rollout_judge
from lfd.run.trial import EvalRecipe, Trial
from lfd.run.wilson import wilson_interval
from lfd.train.behavior_cloning import train
from lfd.train.checkpoint import training_folder
from lfd.train.recipe import TrainRecipe
from lfd.worlds.robosuite_world import RobosuiteWorld
from lfd.worlds.rollout import OneEach, Start, episode_rng, rollouts

STAGE = "dagger"
REPORT, SECONDS = "report.json", "seconds.json"
PER_ROUND = 100_000
"""Numbers of episodes that a round may use; (stage, seed, round * PER_ROUND + episode) decide a rollout."""
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Round:
    """A round: its number i, its place, and what the rounds before it left."""

    number: int
    beta: float
    out: Path
    """Folder of the whole loop."""
    recipes: LoopRecipes
    worlds: Sequence[RobosuiteWorld]
    labels_before: int
    person: Person | None
    """The expert, where it is a person."""
    watched: Callable[[], Observers]
    """What else watches the episodes of rollouts and of an evaluation that begin."""
    progress: Progress

    @property
    def folder(self) -> Path:
        return round_folder(self.out, self.number)

    def run(self) -> Row:
        """What `report.json` holds of the round, which is made unless it is there."""
        if (self.folder / REPORT).is_file():
            return json.loads((self.folder / REPORT).read_text(encoding="utf-8"))
        recordings, dagger = self.folder / "recordings", self.recipes.dagger
        with self._lap("rollout"):
            if self.number == 0:
                self._demonstrate(recordings)
            else:
                self._roll_out(recordings)
        files = sorted(recordings.glob(f"*{SUFFIX}"))
        counted = [counts_of(file, expert_acts=self.number == 0) for file in files]
        with self._lap("convert"):
            self._aggregate([file for file, counts in zip(files, counted, strict=True) if counts.labels])
        with self._lap("train"):
            steps, loss = self._retrain()
        counts = sum(counted, Counts())
        row: Row = {"round": self.number, "beta": self.beta, "episodes": len(files), **asdict(counts)}
        row |= {"labels_total": self.labels_before + counts.labels, "gradient_steps": steps, "loss": loss}
        policy = self.folder / "policy"
        with self._lap("eval"):
            if dagger.judge_episodes:
                judged = replace(self.recipes.tried, episodes=dagger.judge_episodes)
                row["judged"] = successes(policy, judged, self.worlds, JUDGE, self.progress, self.watched())
                row["judged"] /= dagger.judge_episodes
            if dagger.evaluate == "every":
                row |= evaluated(policy, self.recipes.tried, self.worlds, self.progress, self.watched())
        row["seconds"] = _seconds(self.folder)
        write_json(self.folder / REPORT, row)
        return row

    def _demonstrate(self, recordings: Path) -> None:
        """Round 0: beta = 1, the expert acts. As all demonstrations it does so with the noise of its recipe."""
        recipe = self.recipes.record
        begun = read_manifest(recordings) is not None
        if begun and len(numbers_in(recordings, "$")) >= recipe.episodes:
            return
        if self.person is not None and self.person.demonstrates:
            self.person.demonstrate(recipe, recordings, tables=self.recipes.tables, resume=begun)
            return
        record(
            recipe, recordings, tables=self.recipes.tables, most_worlds=len(self.worlds), resume=begun,
            overwrite=not begun, progress=self.progress, observers=self.watched(),
        )  # fmt: skip

    def _roll_out(self, recordings: Path) -> None:
        """Rollouts of pi_i, in waves that cannot use up more labels than are left."""
        dagger, recipes = self.recipes.dagger, self.recipes
        if read_manifest(recordings) is None:
            begin_recordings(recordings, recipes.tables, dagger.seed)
        if self.person is not None:
            self._look_after(self.person, recordings)
            return
        control, watching, following, left = self._control(), self.watched(), 0, self._budget()
        with self.progress(f"round {self.number}", dagger.episodes_per_round) as bar:
            while following < dagger.episodes_per_round and (left is None or left > 0):
                count, horizon = wave(dagger.episodes_per_round - following, left, recipes.horizon)
                numbers = range(following, following + count)
                there = set(numbers_in(recordings, "$"))
                bar.advance(len(there.intersection(numbers)))
                wanted = [number for number in numbers if number not in there]
                for solved in self._episodes(control, recordings, wanted, horizon, watching):
                    bar.advance(note=f"beta {self.beta:.2g}, {'solved' if solved else 'failed'}")
                if left is not None:
                    files = [path for n in numbers if (path := _file(recordings, n)).is_file()]
                    left -= sum(counts_of(file).labels for file in files)
                following += count

    def _episodes(
        self, control: BatchPolicy, out: Path, numbers: Sequence[int], horizon: int, watching: Observers
    ) -> Iterator[bool]:
        """Run and record the episodes of some numbers; whether each was solved."""
        waiting = iter(numbers)

        def next_start() -> Start | None:
            number = next(waiting, None)
            if number is None:
                return None
            seen_by = [self._recorder(out, control.name, number), *watching(number)]
            return Start(index=self._index(number), rng=self._generator(number), observers=seen_by)

        hold_steps = self.recipes.record.hold_steps
        for _, outcome in rollouts(self.worlds, control, next_start, horizon=horizon, hold_steps=hold_steps):
            yield outcome.success

    def _look_after(self, person: Person, recordings: Path) -> None:
        """Rollouts in a person's care; what they discard leaves a gap in the numbers."""
        there, learners, recipes = numbers_in(recordings, "$"), self._learners(), self.recipes
        wanted = recipes.dagger.episodes_per_round - len(there)
        if wanted > 0:
            done = person.look_after(
                learners, self.worlds[0], self._generator,
                lambda number: self._recorder(recordings, learners[0].name, number),
                first=max(there, default=-1) + 1, wanted=wanted,
                horizon=recipes.horizon, hold_steps=recipes.record.hold_steps,
                rest_seconds=recipes.dagger.gate_rest_seconds, longer="--set dagger.rollout_seconds=60",
            )  # fmt: skip
            if done.successes + done.failures < wanted:
                raise InputError(QUIT)

    def _index(self, number: int) -> int:
        """(stage, seed, index) decide the rollout with a number."""
        return self.number * PER_ROUND + number

    def _generator(self, number: int) -> np.random.Generator:
        return episode_rng(STAGE, self.recipes.dagger.seed, self._index(number))

    def _recorder(self, out: Path, policy: str, number: int) -> McapRecorder:
        seed, tables = self.recipes.dagger.seed, self.recipes.tables
        origin = Origin(stage=STAGE, policy=policy, seed=seed, index=self._index(number), recipe=tables)
        return McapRecorder(_file(out, number), origin, keep_failures=True)

    def _learners(self) -> list[BatchPolicy]:
        """The policies of the round before."""
        for world in self.worlds:
            take_cameras(world, self.recipes.record)
        before = round_folder(self.out, self.number - 1)
        return [learner_of(folder, self.recipes.tried, self.worlds) for folder in members(before, self.recipes)]

    def _control(self) -> BatchPolicy:
        """pi_i: the expert and the policies of the round before, and what decides between them."""
        expert = OneEach([make_expert(world.spec, self.recipes.record.style) for world in self.worlds])
        learners = self._learners()
        rounds = [round_folder(self.out, number) / "recordings" for number in range(self.number)]
        recordings = [sorted(folder.glob(f"*{SUFFIX}")) for folder in rounds]
        return who_acts(self.recipes, self.beta, expert, learners, recordings, self.worlds[0].spec.labels["action"])

    def _budget(self) -> int | None:
        """Labels that the round may use; none for as many as its rollouts take."""
        dagger = self.recipes.dagger
        limits = [dagger.labels_per_round] if dagger.labels_per_round else []
        limits += [max(0, dagger.max_labels - self.labels_before)] if dagger.max_labels else []
        return min(limits, default=None)

    def _aggregate(self, files: Sequence[Path]) -> None:
        """D <- D u D_i, where D_i has labels: with a gate, the expert may never have been asked."""
        dataset = self.out / "dataset"
        heal(dataset)
        known = set((read_manifest(dataset) or {}).get("parents", {}).values()) if dataset.is_dir() else set()
        if files and sha256(files[0]) not in known:  # a dataset grows by whole rounds
            convert(files, dataset, recipe=self.recipes.source, append=self.number > 0, progress=self.progress)

    def _retrain(self) -> tuple[int, float]:
        """Retrain every member on D; gradient steps of all of them, and the first one's loss."""
        recipe, dagger = self.recipes.train, self.recipes.dagger
        last = dagger.last_steps > 0 and self.number == dagger.rounds - 1
        warm = self.number > 0 and dagger.retrain == "warm" and not last
        if warm or last:
            recipe = replace(recipe, steps=dagger.last_steps if last else dagger.warm_steps)
        before = members(round_folder(self.out, self.number - 1), self.recipes) if warm else ()
        done = []
        for number, folder in enumerate(members(self.folder, self.recipes)):
            own, told = replace(recipe, seed=recipe.seed + number), folder.with_suffix(".trained.json")
            heal(folder)
            if not (folder.is_dir() and told.is_file()):
                self._train(own, folder, before[number] if warm else None, told)
            done.append(json.loads(told.read_text(encoding="utf-8")))
        return sum(each["steps"] for each in done), done[0]["loss"]

    def _train(self, recipe: TrainRecipe, folder: Path, init: Path | None, told: Path) -> None:
        tried, checkpoint = self.recipes.tried, training_folder(folder) / "checkpoint"
        heal(checkpoint)
        resume = checkpoint.is_dir()
        trained = train(
            self.recipes.policy,
            recipe,
            self.out / "dataset",
            folder,
            tables=self.recipes.tables,
            init=init,
            judge=rollout_judge(tried, recipe.judge_episodes) if recipe.judge_episodes else None,
            resume=resume,
            overwrite=True,  # what a killed run left without a checkpoint, or without its report
            progress=self.progress,
        )
        write_json(told, {"steps": trained.steps, "loss": trained.loss})

    @contextmanager
    def _lap(self, stage: str) -> Iterator[None]:
        """Adds to the round's seconds what the block takes; of a process that was killed the last block is lost."""
        began = time.perf_counter()
        yield
        self.folder.mkdir(parents=True, exist_ok=True)
        spent = _seconds(self.folder)
        spent[stage] = round(spent.get(stage, 0.0) + time.perf_counter() - began, 2)
        write_json(self.folder / SECONDS, spent)


def round_folder(out: Path, number: int) -> Path:
    """Where round `number` of the loop in `out` is."""
    return out / f"round_{number:03d}"


def members(folder: Path, recipes: LoopRecipes) -> list[Path]:
    """The policies of a round, the first of which is the one that is evaluated and handed over."""
    return [folder / "policy", *(folder / f"member_{number}" for number in range(1, recipes.dagger.members))]


def wave(wanted: int, left: int | None, horizon: int) -> tuple[int, int]:
    """How many of the `wanted` rollouts may run side by side with `left` labels, and for how many steps at the most.

    Each step may cost a label. Where not even one whole rollout is covered, one is cut off when the labels end.
    """
    if left is None:
        return wanted, horizon
    if left < horizon:
        return 1, left
    return min(wanted, left // horizon), horizon


def counts_of(file: Path, *, expert_acts: bool = False) -> Counts:
    """What a recording cost the expert, who acted in every step of a demonstration."""
    episode = episode_of(read_mcap(file), file, with_states=False)
    said, acted = episode.expert_actions, episode.interventions | expert_acts
    asked = np.zeros_like(acted) if said is None else np.isfinite(said[:, 0])
    return Counts.of(
        Decision(action, expert_action=action if label else None, intervention=bool(overruled))
        for action, label, overruled in zip(episode.actions, asked, acted, strict=True)
    )


def successes(
    policy: Path,
    recipe: EvalRecipe,
    worlds: Sequence[RobosuiteWorld],
    stage: str,
    progress: Progress,
    observers: Observers = unwatched,
) -> int:
    """How many of the episodes of an evaluation a policy solves, from the start states of a stage."""
    solved = 0
    with progress(stage, recipe.episodes) as bar:
        for _, outcome in Trial.of(policy, recipe).run(worlds, stage, range(recipe.episodes), observers):
            solved += outcome.success
            bar.advance(note=f"{solved} solved")
    return solved


def evaluated(
    policy: Path,
    recipe: EvalRecipe,
    worlds: Sequence[RobosuiteWorld],
    progress: Progress,
    observers: Observers = unwatched,
) -> Row:
    """An evaluation as rows of a report: what `lfd eval` measures, without its recordings."""
    solved = successes(policy, recipe, worlds, "eval", progress, observers)
    interval = wilson_interval(solved, recipe.episodes)
    return {"success_rate": solved / recipe.episodes, "interval": list(interval), "successes": solved}


def _file(recordings: Path, number: int) -> Path:
    return recordings / f"{EPISODE}{number:06d}{SUFFIX}"


def _seconds(folder: Path) -> dict[str, float]:
    path = folder / SECONDS
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
