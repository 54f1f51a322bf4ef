import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from lfd.core.errors import InputError
from lfd.interaction.responses import NoResponse, SingularResponse, best_response, response_jacobian
from lfd.interaction.stackelberg import leader_gradient, plan_stackelberg

A = torch.tensor([[2.0, 0.3], [0.3, 1.0]], dtype=torch.float64)
B = torch.tensor([[1.0, -0.5, 0.2], [0.4, 0.7, -1.0]], dtype=torch.float64)
U = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
ZERO = torch.zeros(2, dtype=torch.float64)


def quadratic(u_robot, u_human):
    return -0.5 * u_human @ A @ u_human + u_human @ B @ u_robot


def curved(u_robot, u_human):
    return -((u_human**4).sum()) - 0.5 * u_human @ A @ u_human + torch.sin(u_robot).sum() * torch.tanh(u_human).sum()


def robot(u_robot, u_human):
    return -((u_robot - 0.4) ** 2).sum() + torch.cos(u_human).sum() + u_robot[0] * u_human[1]


def test_the_response_to_a_quadratic_reward_is_its_closed_form() -> None:
    expected = torch.linalg.solve(A, B @ U)
    torch.testing.assert_close(best_response(quadratic, U, ZERO), expected, atol=1e-12, rtol=0.0)
    torch.testing.assert_close(
        response_jacobian(quadratic, U, expected), torch.linalg.solve(A, B), atol=1e-12, rtol=0.0
    )


@pytest.mark.parametrize("reward", [quadratic, curved])
@pytest.mark.parametrize("bounds", [None, (-0.1, torch.tensor([0.05, 0.9], dtype=torch.float64))])
def test_the_response_is_scipys_and_its_jacobian_that_of_finite_differences(reward, bounds) -> None:
    low, high = (-np.inf, [np.inf] * 2) if bounds is None else (bounds[0], bounds[1].tolist())
    found = minimize(
        lambda u: -float(reward(U, torch.from_numpy(u))), np.zeros(2), method="L-BFGS-B",
        bounds=[(low, high[0]), (low, high[1])], options={"ftol": 1e-16, "gtol": 1e-9},
    )  # fmt: skip
    u = best_response(reward, U, ZERO, bounds=bounds)
    np.testing.assert_allclose(u.numpy(), found.x, atol=1e-5)
    if bounds is not None:
        assert (u.numpy() == high).any() or (u.numpy() == low).any()
    step = 1e-6
    columns = [
        (best_response(reward, U + step * e, u, bounds=bounds) - best_response(reward, U - step * e, u, bounds=bounds))
        / (2.0 * step)
        for e in torch.eye(3, dtype=torch.float64)
    ]
    torch.testing.assert_close(
        response_jacobian(reward, U, u, bounds=bounds), torch.stack(columns, dim=1), atol=1e-7, rtol=0.0
    )


@pytest.mark.parametrize("reward", [quadratic, curved])
@pytest.mark.parametrize("bounds", [None, (-0.1, 0.05)])
def test_the_leaders_gradient_is_that_of_finite_differences(reward, bounds) -> None:
    u = best_response(reward, U, ZERO, bounds=bounds)
    step, numeric = 1e-6, []
    for e in torch.eye(3, dtype=torch.float64):
        ends = [U + step * e, U - step * e]
        high, low = (robot(v, best_response(reward, v, u, bounds=bounds)) for v in ends)
        numeric.append((high - low) / (2.0 * step))
    gradient = leader_gradient(robot, reward, U, u, bounds=bounds)
    torch.testing.assert_close(gradient, torch.stack(numeric), atol=1e-7, rtol=0.0)


def test_a_plan_is_a_maximum_of_what_the_robot_gets_after_the_persons_answer() -> None:
    plan = plan_stackelberg(robot, curved, U, ZERO, robot_bounds=(-1.0, 1.0))
    assert plan.converged
    torch.testing.assert_close(plan.u_human, best_response(curved, plan.u_robot, ZERO), atol=1e-9, rtol=0.0)
    assert plan.value == pytest.approx(float(robot(plan.u_robot, plan.u_human)))
    generator = torch.Generator().manual_seed(0)
    for _ in range(50):
        near = torch.clamp(plan.u_robot + 0.05 * torch.randn(3, generator=generator, dtype=torch.float64), -1.0, 1.0)
        assert float(robot(near, best_response(curved, near, plan.u_human))) <= plan.value + 1e-9
    assert plan.human_solves < 40


def test_a_robot_that_knows_the_answer_does_better_than_one_that_takes_the_person_as_fixed() -> None:
    def yields(u_robot, u_human):  # the person moves away from the robot
        return -((u_human + 0.8 * u_robot[:2]) ** 2).sum()

    def wants(u_robot, u_human):  # and the robot wants them far away, near 0 itself
        return -(u_robot**2).sum() - ((u_human + 1.0) ** 2).sum()

    plan = plan_stackelberg(wants, yields, torch.zeros(3, dtype=torch.float64), ZERO)
    # u_H = -0.8 u: maximise -u^2 - (1 - 0.8 u)^2 for each of two, hence u = 0.8 / 1.64
    torch.testing.assert_close(
        plan.u_robot, torch.tensor([0.8 / 1.64, 0.8 / 1.64, 0.0], dtype=torch.float64), atol=1e-6, rtol=0.0
    )


def test_a_saddle_is_left() -> None:
    u = best_response(lambda _, u: u[0] ** 2 - u[0] ** 4 - u[1] ** 2, U, ZERO)
    np.testing.assert_allclose(np.abs(u.numpy()), [np.sqrt(0.5), 0.0], atol=1e-8)


def test_a_flat_reward_is_singular_and_a_ridge_helps() -> None:
    def flat(u_robot, u_human):
        return -((u_human[0] - u_robot[0]) ** 2)

    with pytest.raises(SingularResponse, match="along a flat direction anything is as good"):
        best_response(flat, U, ZERO)
    with pytest.raises(SingularResponse):
        response_jacobian(flat, U, torch.tensor([0.3, 0.0], dtype=torch.float64))
    with pytest.raises(SingularResponse):
        leader_gradient(robot, flat, U, torch.tensor([0.3, 0.0], dtype=torch.float64))
    regular = response_jacobian(flat, U, torch.tensor([0.3, 0.0], dtype=torch.float64), ridge=1e-8)
    torch.testing.assert_close(
        regular, torch.tensor([[1.0, 0, 0], [0, 0, 0]], dtype=torch.float64), atol=1e-7, rtol=0.0
    )


def test_a_plan_among_people_to_whom_some_is_the_same_tells_what_was_added() -> None:
    def flat(u_robot, u_human):
        return -((u_human[0] - u_robot[0]) ** 2)

    with pytest.raises(SingularResponse, match="ridge=1e-6"):
        plan_stackelberg(robot, flat, U, ZERO)
    plan = plan_stackelberg(robot, flat, U, ZERO, robot_bounds=(-1.0, 1.0), ridge=1e-6)
    assert plan.ridge == 1e-6
    assert float(plan.u_human[1]) == 0.0  # they stay where they were
    assert float(plan.u_human[0]) == pytest.approx(float(plan.u_robot[0]), abs=1e-8)
    small = 1e-6  # the same person, who would rather not move
    close = plan_stackelberg(robot, lambda a, b: flat(a, b) - small * b[1] ** 2, U, ZERO, robot_bounds=(-1.0, 1.0))
    torch.testing.assert_close(plan.u_robot, close.u_robot, atol=1e-4, rtol=0.0)
    assert close.ridge == 0.0
    regular = plan_stackelberg(robot, curved, U, ZERO, ridge=1e-6, robot_bounds=(-1.0, 1.0))
    assert regular.ridge == 0.0
    assert regular.value == pytest.approx(plan_stackelberg(robot, curved, U, ZERO, robot_bounds=(-1.0, 1.0)).value)
    with pytest.raises(SingularResponse):  # too little, beside a curvature of 2
        plan_stackelberg(robot, flat, U, ZERO, ridge=1e-11)


def test_what_has_no_answer_is_said() -> None:
    with pytest.raises(NoResponse, match="give bounds"):
        best_response(lambda _, u: u.sum(), U, ZERO)
    assert best_response(lambda _, u: u.sum(), U, ZERO, bounds=(-1.0, 2.0)).tolist() == [2.0, 2.0]
    with pytest.raises(InputError, match="reward_human has the slope"):
        best_response(lambda _, u: torch.sqrt(u - 1.0).sum(), U, ZERO)
    with pytest.raises(InputError, match="bounds cross"):
        best_response(quadratic, U, ZERO, bounds=(1.0, -1.0))
    with pytest.raises(InputError, match="bounds have shapes"):
        best_response(quadratic, U, ZERO, bounds=(torch.zeros(3), torch.ones(3)))
    with pytest.raises(InputError, match=r"u_robot has shape \(1, 3\)"):
        best_response(quadratic, U[None], ZERO)
    with pytest.raises(InputError, match="u_human_init is"):
        best_response(quadratic, U, ZERO * torch.nan)


def test_a_control_that_ends_beside_its_bound_by_rounding_is_held_there() -> None:
    def person(u_robot, u_human):
        return u_human[0] * 3.0 - (u_human[1] - 0.2) ** 2 - 0.1 * (u_human**4).sum()

    beside = torch.tensor([1.0 - 4e-16, 0.9], dtype=torch.float64)
    u = best_response(person, U, beside, bounds=(-1.0, 1.0))
    assert u[0] == pytest.approx(1.0)
    jacobian = response_jacobian(lambda a, b: person(a, b) + a.sum() * b.sum(), U, u, bounds=(-1.0, 1.0))
    assert (jacobian[0] == 0.0).all()


def test_people_one_after_the_other_answer_as_each_of_them_alone() -> None:
    def two(u_robot, u_human):
        return quadratic(u_robot, u_human[:2]) + curved(u_robot, u_human[2:])

    together = best_response(two, U, torch.zeros(4, dtype=torch.float64), bounds=(-0.1, 0.9), followers=2)
    alone = [best_response(reward, U, ZERO, bounds=(-0.1, 0.9)) for reward in (quadratic, curved)]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-9, rtol=0.0)

    def leader(u_robot, u_human):
        return robot(u_robot, u_human[:2]) + (u_human[2:] * u_robot[:2]).sum()

    blocks, whole = (leader_gradient(leader, two, U, together, bounds=(-0.1, 0.9), followers=n) for n in (2, 1))
    torch.testing.assert_close(blocks, whole, atol=1e-12, rtol=0.0)
