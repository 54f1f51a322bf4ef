"""Stackelberg plans again and again: within limits, from several starts, in bounded time (chapter 10.6.1).

At every control step the start with the highest J is improved by a few gradients, and a part of the plan is carried
out. J has a maximum for each way around the other, such as before and behind: from one start only the nearest is found.
"""

import time
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lfd.core.errors import InputError
from lfd.interaction.responses import Bounds, Derivatives, Reward, best_response, limits, vector
from lfd.interaction.stackelberg import Plan, plan_stackelberg

TOLERANCE = 1e-4
"""Of best responses, relative as in `best_response`: Newton's next step would end near 1e-8."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What plans are kept within."""

    robot: Bounds
    person: Bounds
    gradients: int
    """Gradients for each plan, at the most but for the last line search."""
    difference: float = 0.0
    """Step of finite differences in the implicit gradient's place; 0 for the implicit one."""
    ridge: float = 0.0
    """For people whose answer is singular, as in `plan_stackelberg`; 0 refuses them."""

    def check(self) -> None:
        """Raise `InputError` for numbers out of range."""
        if self.gradients < 1 or self.difference < 0.0:
            raise InputError(
                f"gradients = {self.gradients}, difference = {self.difference}: give at least 1, and a step that is "
                "not negative"
            )


class RecedingHorizon:
    """A planner that remembers its last plan.

    Of each plan, `seconds` are those of the processor, `solves` the best responses, those to the starts included, and
    `per_gradient` those of one gradient.
    """

    def __init__(self, within: Limits):
        within.check()
        self._limits = within
        self.forget()

    def forget(self) -> None:
        """Begin anew, without a last plan."""
        self._last: Plan | None = None
        self.seconds: list[float] = []
        self.solves: list[int] = []
        self.per_gradient: list[float] = []

    def plan(
        self,
        reward_robot: Reward,
        reward_human: Reward,
        starts: Float[Tensor, "S n"],
        u_human_init: Float[Tensor, "m"],
        *,
        shift: float,
        controls: int,
        followers: int,
        derivatives: Derivatives | None = None,
        person: Bounds | None = None,
    ) -> Plan:
        """The best plan from the last one and from `starts`.

        Rewards take a batch in front: (S, n) and (S, m) give (S,), so that the answers to all starts cost about as much
        as one. `shift` steps of the last plan have been carried out, a part of one included, each of `controls`
        numbers; `followers` as in `best_response`. `derivatives` take a batch in front too: R_H is (S,), g (S, m), the
        blocks are (S, followers, k, k). `person` are bounds for this plan in place of the limits'.

        Raises `InputError` for starts outside the limits, and what `plan_stackelberg` raises.
        """
        began, within = time.process_time(), self._limits
        low, high = limits(within.robot, vector("starts", starts[0]))
        if ((starts < low) | (starts > high)).any():
            raise InputError(f"starts hold {starts.tolist()}, outside of {low.tolist()} to {high.tolist()}")
        answers = u_human_init.expand(len(starts), -1)
        if self._last is not None:
            starts = torch.cat([shifted(self._last.u_robot, shift, controls)[None], starts])
            warm = shifted(self._last.u_human, shift, 1, followers)
            answers = torch.cat([warm[None], answers])
        count = len(starts)
        low_human, high_human = limits(person or within.person, answers[0])

        def of_all(u_robot: Tensor, u_human: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            assert derivatives is not None
            values, g, blocks = derivatives(u_robot.view(count, -1), u_human.view(count, -1))
            return values.sum(), g.flatten(), blocks.flatten(0, 1)

        given = best_response(
            lambda u_robot, u_human: reward_human(u_robot.view(count, -1), u_human.view(count, -1)).sum(),
            starts.reshape(-1),
            answers.reshape(-1),
            bounds=(low_human.repeat(count), high_human.repeat(count)),
            tolerance=TOLERANCE,
            ridge=within.ridge,
            followers=count * followers,
            derivatives=of_all if derivatives is not None else None,
        ).view(count, -1)
        best = int(reward_robot(starts, given).argmax())
        plan = plan_stackelberg(
            reward_robot,
            reward_human,
            starts[best],
            given[best],
            bounds=(low_human, high_human),
            robot_bounds=within.robot,
            max_gradients=within.gradients,
            difference=within.difference,
            ridge=within.ridge,
            followers=followers,
            derivatives=derivatives,
            response_tolerance=TOLERANCE,
        )
        self._last = replace(plan, human_solves=plan.human_solves + count)
        self.seconds.append(time.process_time() - began)
        self.solves.append(self._last.human_solves)
        self.per_gradient.append(plan.human_solves / plan.gradients)
        return self._last


def shifted(u: Float[Tensor, "n"], steps: float, controls: int, followers: int = 1) -> Float[Tensor, "n"]:
    """Controls when some steps of them have passed: in between linearly interpolated, the last one held."""
    rows = u.reshape(followers, -1, controls)
    length = rows.shape[1]
    at = torch.clamp(torch.arange(length, dtype=torch.float64) + steps, max=length - 1.0)
    below = at.floor().long()
    above, part = torch.clamp(below + 1, max=length - 1), (at - below)[:, None]
    return ((1.0 - part) * rows[:, below] + part * rows[:, above]).reshape(-1)
