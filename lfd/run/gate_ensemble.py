"""The ensemble gate: the expert acts where the learners disagree (EnsembleDAgger).

Menda, Driggs-Campbell, Kochenderfer 2019, "EnsembleDAgger: A Bayesian Approach to Safe Imitation Learning": the novice
acts where its doubt (the spread of the ensemble) and its discrepancy from the expert are both small.
"""

from dataclasses import dataclass

from lfd.run.gates import Moment, Ruling, disagreement, discrepancy


@dataclass(frozen=True, kw_only=True)
class EnsembleGate:
    """The expert acts where the doubt is above its threshold, or the discrepancy is, where that has one.

    With a threshold on the discrepancy the expert is asked in every step, and every step is labelled. Without one it is
    asked only where it acts; `lfd.run.gates.budget_threshold` of the doubts in calibration states then sets the share.
    """

    doubt: float
    """Highest disagreement of the learners with which they act [action]."""
    discrepancy: float | None = None
    """Highest distance from the expert's action with which the learner acts [action]; none: the expert isn't asked."""

    def reset(self, place: int) -> None:
        """It has no memory."""

    def rule(self, place: int, moment: Moment) -> Ruling:
        doubt = disagreement(moment.proposals)
        if self.discrepancy is None:
            return Ruling(doubt > self.doubt, measured={"doubt": doubt})
        away = discrepancy(moment.action, moment.ask())
        acts = doubt > self.doubt or away > self.discrepancy
        return Ruling(acts, measured={"doubt": doubt, "discrepancy": away})
