"""Learning what a person wants from answers to "A or B?", one question after the other (chapter 10.5.1).

    U(tau) = w.f(tau) - lambda E(tau),        p(a) = 1 / (1 + exp(-rationality (U(tau_A) - U(tau_B))))

The planner's prior E counts as one more feature whose weight lambda is known, as in `lfd.loops.inverse_rl`: it fixes
the scale of w. A question is a pair of a pool that was not asked about yet. Which one depends on the answers so far and
on the seed alone, so that a comparison that was stopped goes on as if it had not been.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError, UnknownName
from lfd.loops.arm_evidence import SAME
from lfd.loops.comparison_pool import Pool
from lfd.reward_learning.queries import Criterion, joint_batch, query_values
from lfd.reward_learning.weight_belief import WeightBelief, belief_of, updated
from lfd.rewards.factors import CHOICES, Choice, ChoiceFactor, GaussianFactor, check_features
from lfd.rewards.reward_artifact import Change, LinearReward

WIDE = 3.0
"""Standard deviation of weights that nobody said anything about, in `Pool.units`, where the prior's weight is 1."""
SAMPLES = 300
"""Of the belief, when a question is chosen."""
RANDOM = "random"
CRITERIA = ("information_gain", "volume_removal", "expected_volume", RANDOM)
LARGEST_BATCH = 12

Reply = Choice | Literal["undo", "quit"]


@dataclass(frozen=True)
class Question:
    """Two trajectories of the pool to be compared."""

    number: int
    """How many answers came before."""
    a: int
    b: int
    """Numbers in the pool; which of the two is A is drawn."""
    bits: float
    """What an answer is expected to tell about w [bits]; after others of its batch, what it adds to them."""


@dataclass(frozen=True)
class Answer:
    """A question with what was said."""

    question: Question
    choice: str


Person = Callable[[Question], Reply]
"""Who answers."""


@dataclass(frozen=True, kw_only=True)
class Rules:
    """What decides which questions are asked and what answers mean; a comparison that goes on keeps them."""

    criterion: str
    """One of `CRITERIA`."""
    rationality: float
    """Factor on differences in U."""
    batch: int
    """Questions that are chosen together, before any of them is answered."""
    seed: int

    def __post_init__(self) -> None:
        if self.criterion not in CRITERIA:
            raise UnknownName("criterion", self.criterion, CRITERIA)
        if not (np.isfinite(self.rationality) and self.rationality > 0.0):
            raise InputError(f"rationality = {self.rationality}: give a positive number")
        if not 1 <= self.batch <= LARGEST_BATCH:
            raise InputError(f"batch = {self.batch}: give 1 to {LARGEST_BATCH} questions")
        if self.batch > 1 and self.criterion != "information_gain":
            raise InputError(f"batch = {self.batch} is for information_gain; {self.criterion} asks one by one")


@dataclass
class Comparison:
    """A comparison as far as it went: the answers grow."""

    pool: Pool
    begin: LinearReward
    """What was known before."""
    rules: Rules
    answers: list[Answer] = field(default_factory=list)
    _batches: dict[int, list[Question]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_features(self.pool.features, self.begin.features, "the pool")
        for key in SAME:
            if getattr(self.pool.recipe, key) != getattr(self.begin, key):
                raise InputError(
                    f"the pool was planned with {key} = {getattr(self.pool.recipe, key)}, the reward with "
                    f"{getattr(self.begin, key)}; weights are comparable only for the same arm and planner"
                )

    def factor(self, answer: Answer) -> ChoiceFactor:
        """An answer as evidence about w."""
        away = self.pool.counts[answer.question.a] - self.pool.counts[answer.question.b]
        offset = self.begin.smoothness * float(away[-1])
        return ChoiceFactor(away[:-1], offset, answer.choice, self.rules.rationality)

    def belief(self, count: int | None = None) -> WeightBelief:
        """p(w) after the first `count` answers, or all."""
        known = self.answers[:count]
        return WeightBelief([*belief_of(self.begin).factors, *map(self.factor, known)])

    def question(self) -> Question | None:
        """The next question; None when all pairs were asked about."""
        number = len(self.answers)
        first = number - number % self.rules.batch
        if first not in self._batches:
            self._batches[first] = self._chosen(first)
        batch = self._batches[first]
        return batch[number - first] if number - first < len(batch) else None

    def answer(self, question: Question, choice: str) -> None:
        """Take in an answer to the present question. Raises `UnknownName` for one that is no choice."""
        if choice not in CHOICES:
            raise UnknownName("choice", choice, CHOICES)
        self.answers.append(Answer(question, choice))

    def undo(self) -> Answer:
        """Take back the last answer; its question comes again. Raises `InputError` when there is none."""
        if not self.answers:
            raise InputError("nothing to undo: no question was answered yet")
        self._batches = {first: batch for first, batch in self._batches.items() if first < len(self.answers)}
        return self.answers.pop()

    def reward(self) -> LinearReward:
        """The reward after all answers, each an entry of its history."""
        reward, names = self.begin, self.pool.names
        for number, answer in enumerate(self.answers, 1):
            a, b = names[answer.question.a], names[answer.question.b]
            told = {"a": f"{a} over {b}", "b": f"{b} over {a}", "equal": f"{a} about equal to {b}"}[answer.choice]
            reward = updated(reward, self.factor(answer), f"answer {number}: {told}")
        return reward

    def _chosen(self, first: int) -> list[Question]:
        """The batch that begins after `first` answers."""
        rng = np.random.default_rng([5, self.rules.seed, first])
        asked = {frozenset((a.question.a, a.question.b)) for a in self.answers[:first]}
        pairs = np.array([pair for pair in self.pool.pairs.tolist() if frozenset(pair) not in asked]).reshape(-1, 2)
        if not len(pairs):
            return []
        belief = self.belief(first)
        samples = np.column_stack([belief.sample(SAMPLES, rng), np.full(SAMPLES, self.begin.smoothness)])
        away = self.pool.counts[pairs[:, 0]] - self.pool.counts[pairs[:, 1]]
        swapped = rng.random(self.rules.batch) < 0.5
        questions = []
        for place, (chosen, bits) in enumerate(self._best(away, samples, rng)):
            a, b = pairs[chosen][::-1] if swapped[place] else pairs[chosen]
            questions.append(Question(first + place, int(a), int(b), bits))
        return questions

    def _best(
        self, away: Float[np.ndarray, "P K1"], samples: Float[np.ndarray, "M K1"], rng: np.random.Generator
    ) -> list[tuple[int, float]]:
        """Numbers of the pairs to ask about next, and the bits that each tells."""
        rules = self.rules
        if rules.batch > 1:
            return joint_batch(away, samples, rules.batch, rationality=rules.rationality)
        bits = query_values(away, samples, criterion="information_gain", rationality=rules.rationality)
        if rules.criterion == RANDOM:
            best = int(rng.integers(len(away)))
        else:
            criterion: Criterion = "information_gain"
            if rules.criterion != "information_gain":
                criterion = "volume_removal" if rules.criterion == "volume_removal" else "expected_volume"
            best = int(query_values(away, samples, criterion=criterion, rationality=rules.rationality).argmax())
        return [(best, float(bits[best]))]


def no_answers_yet(pool: Pool) -> LinearReward:
    """A reward about which nobody said anything: weights of 0 with a wide spread."""
    recipe, spread = pool.recipe, WIDE * pool.units
    weights = np.zeros(len(pool.features))
    factor = GaussianFactor(weights, np.diag(spread**-2.0))
    words = (
        f"nobody was asked: each weight of either sign, +- {WIDE:g} times what weighs as much as the planner's prior"
    )
    return LinearReward(
        features=pool.features,
        weights=weights,
        ranges=pool.ranges[:-1].copy(),
        robot=recipe.robot,
        waypoints=recipe.waypoints,
        duration_s=recipe.duration_s,
        smoothness=recipe.smoothness,
        method="comparisons",
        covariance=np.diag(spread**2.0),
        history=(Change(words, (), tuple(weights.tolist()), factor),),
    )


def ask(
    comparison: Comparison,
    person: Person,
    *,
    questions: int,
    stop_below: float,
    save: Callable[[Comparison], None],
    tell: Callable[[str], None] = lambda _: None,
) -> str:
    """Ask until `questions` are answered or something else ends it; why it ended, in words.

    A question that is expected to tell less than `stop_below` bits is not asked. `save` is called after each answer.
    """
    while len(comparison.answers) < questions:
        question = comparison.question()
        if question is None:
            return "every pair of the pool was asked about"
        if question.bits < stop_below:
            return f"no question was worth its cost: the best would tell {question.bits:.3g} bits"
        reply = person(question)
        if reply == "quit":
            return "stopped; --resume goes on"
        if reply == "undo" and not comparison.answers:
            tell("nothing to undo: no question was answered yet")
            continue
        if reply == "undo":
            comparison.undo()
        else:
            comparison.answer(question, reply)
        save(comparison)
    return f"{questions} questions were answered"


def answers_table(comparison: Comparison) -> list[dict[str, Any]]:
    """The answers as JSON has them."""
    return [{**vars(answer.question), "choice": answer.choice} for answer in comparison.answers]


def answers_of(table: Sequence[Any], pool: Pool, where: str) -> list[Answer]:
    """The answers that `answers_table` wrote. Raises `InputError` for what is none."""
    found = []
    for number, row in enumerate(table):
        try:
            question = Question(row["number"], row["a"], row["b"], float(row["bits"]))
        except (TypeError, KeyError, ValueError) as error:
            raise InputError(f"{where}: answer {number} is none ({error!r}); compare again") from error
        known = range(len(pool.names))
        if question.number != number or question.a not in known or question.b not in known:
            raise InputError(f"{where}: answer {number} is about {row}, which is no pair of the pool; compare again")
        if row.get("choice") not in CHOICES:
            raise UnknownName("choice", str(row.get("choice")), CHOICES)
        found.append(Answer(question, row["choice"]))
    return found


def alignment(weights: Float[np.ndarray, "K"], truth: Float[np.ndarray, "K"], ranges: Float[np.ndarray, "K"]) -> float:
    """Cosine between two weights in units of the ranges; 0 where one of them is 0."""
    one, other = weights * ranges, truth * ranges
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / size if size else 0.0


def alignments(comparison: Comparison, truth: Float[np.ndarray, "K"]) -> list[float]:
    """The alignment of the belief's mode before any answer and after each."""
    ranges, counts = comparison.begin.ranges, range(len(comparison.answers) + 1)
    return [alignment(comparison.belief(count).mode, truth, ranges) for count in counts]
