"""The `[dagger]` table of a file in `policies/`, and all the tables that a loop of DAgger goes by."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from lfd.convert.sources import SourceRecipe
from lfd.core.errors import RecipeError, UnknownName
from lfd.core.recipe import Table, as_table, build
from lfd.record.demonstrations import RecordRecipe
from lfd.run.control import PER, SCHEDULES, beta_schedule
from lfd.run.trial import EvalRecipe
from lfd.train.recipe import TrainRecipe

LEARN_TABLES = ("policy", "train", "eval", "dagger")
DATA_TABLES = ("record", "convert", "video")
RETRAIN = {
    "scratch": "all [train] steps from new weights, in every round",
    "warm": "`warm_steps` from the weights of the round before",
}
EVALUATE = {
    "every": "the policy of every round is evaluated",
    "last": "only the policy that is handed over",
}
HUMAN = "human"
GATES = {
    "none": "a coin decides who acts (beta), and the expert labels every step",
    "ensemble": "the expert acts where members disagree or are far from it, and labels every step",
    "safe": "the expert acts where a classifier expects the learner to err, and labels those steps (SafeDAgger)",
    HUMAN: "a person takes over and hands back, and labels the steps in which they act (HG-DAgger)",
    "thrifty": "the expert takes over in new or risky states, until the two agree (ThriftyDAgger)",
}


@dataclass(frozen=True, kw_only=True)
class DaggerRecipe:
    """How data are aggregated."""

    rounds: int
    """Rounds of Algorithm 1; the first consists of the demonstrations."""
    demonstrations: int
    """Successful demonstrations of the first round."""
    episodes_per_round: int
    """Rollouts of each further round; fewer where `labels_per_round` or `max_labels` is used up before."""
    seed: int
    """Seed of the rollouts' start states and coins; they differ from those of recordings and evaluations."""
    rollout_seconds: float = 0.0
    """Simulated time of a rollout [s], after which a learner that got stuck shows the expert nothing new; 0 takes as
    long as a demonstration may."""
    labels_per_round: int = 0
    """Labels of each further round, where its last rollout is cut off; 0 cuts none."""
    max_labels: int = 0
    """Labels of all rounds, demonstrations included, at which the last rollout is cut off; 0 sets no limit."""
    beta: str = "first"
    """How the expert's share of control falls: first (1, then 0), exponential or linear."""
    beta_rate: float = 0.5
    """Factor on beta from round to round when it is exponential."""
    per: str = "step"
    """How long a coin counts that decides who acts: step, as in Algorithm 1, or episode."""
    retrain: str = "scratch"
    """What a round trains: scratch (all [train] steps from new weights) or warm (`warm_steps` from the last ones)."""
    warm_steps: int = 1000
    """Gradient steps of a round that goes on from the weights of the round before."""
    last_steps: int = 0
    """Gradient steps of the last round, from new weights: warm rounds collect cheaply, the last one learns thoroughly;
    0 trains it as the others."""
    judge_episodes: int = 0
    """Rollouts, on start states of their own, by which the best round's policy is chosen; 0 takes the last round's."""
    evaluate: str = "every"
    """Which policies are evaluated by [eval]: every (each round's) or last (the one that is handed over)."""
    gate: str = "none"
    """What decides who acts: none (the coin), ensemble, safe, thrifty, or with --device human; docs/dagger.md compares
    them."""
    members: int = 1
    """Policies that each round trains, from other initial weights; a rollout's learner acts as their mean."""
    gate_share: float = 0.2
    """Share of the states of the last round that would call the expert; for safe also that of the unsafe ones."""
    gate_distance: float = 0.5
    """Ensemble: distance from the expert's action beyond which the expert acts [action]; 0 does not ask for it."""
    gate_discount: float = 0.98
    """Thrifty: factor a step on the probability that the task will be solved."""
    gate_rest_seconds: float = 0.5
    """Human: rest of the device after which control goes back to the learner [s]; 0 leaves it to their word."""

    def check(self, where: str) -> None:
        for key in ("rounds", "demonstrations", "episodes_per_round", "warm_steps", "members"):
            if getattr(self, key) <= 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be greater than 0")
        for key in (
            "seed", "labels_per_round", "max_labels", "last_steps", "judge_episodes", "gate_distance",
            "rollout_seconds", "gate_rest_seconds",
        ):  # fmt: skip
            if getattr(self, key) < 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must not be negative")
        for key in ("beta_rate", "gate_share", "gate_discount"):
            if not 0.0 <= getattr(self, key) <= 1.0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must lie within 0 and 1")
        for key, known in (
            ("beta", SCHEDULES), ("per", PER), ("retrain", RETRAIN), ("evaluate", EVALUATE), ("gate", GATES),
        ):  # fmt: skip
            if getattr(self, key) not in known:
                raise UnknownName(f"{key} in {where}:", getattr(self, key), known)
        if self.gate in ("ensemble", "thrifty") and self.members < 2:
            raise RecipeError(f'{where} gate = "{self.gate}" compares members: set members = 3')
        if self.gate != "none" and not 0.0 < self.gate_share < 1.0:
            raise RecipeError(f"{where} gate_share = {self.gate_share}: a gate needs a share between 0 and 1")
        if self.gate == HUMAN and (self.labels_per_round or self.max_labels):
            raise RecipeError(f"{where} a person's episodes are not cut off: leave out labels_per_round and max_labels")
        if self.last_steps and self.max_labels:
            raise RecipeError(
                f"{where} max_labels may end the loop before the last round, which last_steps is for: leave out one"
            )

    @property
    def betas(self) -> tuple[float, ...]:
        """beta_i of every round; a gate takes the coin's place, but for the demonstrations."""
        return beta_schedule(self.beta if self.gate == "none" else "first", self.rounds, rate=self.beta_rate)


@dataclass(frozen=True, kw_only=True)
class LoopRecipes:
    """What the stages of a loop go by."""

    policy: Table
    """The `[policy]` table."""
    record: RecordRecipe
    source: SourceRecipe
    train: TrainRecipe
    tried: EvalRecipe
    dagger: DaggerRecipe
    tables: dict[str, Table]
    """All tables as they are used."""

    @classmethod
    def of(cls, learn: Mapping[str, Table], data: Mapping[str, Table], where: str = "the recipe") -> "LoopRecipes":
        """From the tables of a policy recipe and of a dataset recipe, which messages call `where`.

        Failed rollouts carry labels like all others, so [convert] `failures` counts as true. Raises `RecipeError` for
        tables that cannot be used.
        """
        dagger = build(DaggerRecipe, learn.get("dagger", {}), f"{where} [dagger]")
        record = build(RecordRecipe, data.get("record", {}), f"{where} [record]")
        train = build(TrainRecipe, learn.get("train", {}), f"{where} [train]")
        tried = build(EvalRecipe, learn.get("eval", {}), f"{where} [eval]")
        record = replace(record, episodes=dagger.demonstrations)
        convert = {**data.get("convert", {}), "failures": True}
        if convert.get("action", "expert_action") != "expert_action":
            raise RecipeError(
                f"{where} [convert] action = {convert['action']!r}: DAgger learns from the expert's labels, also where "
                "the learner acted; set convert.action=expert_action"
            )
        if dagger.gate not in ("none", HUMAN) and record.cameras:
            raise RecipeError(
                f'{where} gate = "{dagger.gate}" judges recorded numbers, not pictures: leave out cameras'
            )
        kept = {name: table for name, table in data.items() if name == "video"} | {"convert": convert}
        source = SourceRecipe(where=where, tables=kept)
        source.check()
        used = {"policy": dict(learn.get("policy", {})), "train": as_table(train), "eval": as_table(tried)}
        used |= {"dagger": as_table(dagger), "record": as_table(record), **kept}
        return cls(
            policy=used["policy"], record=record, source=source, train=train, tried=tried, dagger=dagger, tables=used
        )

    @property
    def horizon(self) -> int:
        """Control steps after which a rollout ends."""
        seconds = self.dagger.rollout_seconds or self.record.max_seconds
        return max(1, round(seconds * self.record.control_hz))
