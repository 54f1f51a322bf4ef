from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from lfd.core.errors import InputError
from lfd.core.protocols import Verdict
from lfd.experts.plan_follower import OMEGA, RANGE_RAD, SPEED_RAD_S, PlanFollower
from lfd.loops.plan_demonstrations import stand
from lfd.planning.arm_model import load_arm
from lfd.planning.scenes import cup_scene
from lfd.worlds.robosuite_world import make_world


@cache
def world():
    return make_world("Lift", "panda", 20, controller="JOINT_POSITION")


def swing() -> np.ndarray:
    """From the cup scene's start to its goal and a little around."""
    scene, part = cup_scene(load_arm("panda")), np.linspace(0.0, 1.0, 20)
    ease = part**3 * (10 - 15 * part + 6 * part**2)
    around = np.sin(np.pi * part)[:, None] ** 2 * np.array([0.0, 0.2, -0.3, 0.2, 0.3, -0.2, 0.4])
    return scene.start + ease[:, None] * (scene.goal - scene.start) + around


def test_a_panda_in_lifts_world_stays_within_a_few_milliradians_of_a_plan(rng: np.random.Generator) -> None:
    plan = swing()
    follower = PlanFollower(world().spec, plan, 40.0 / 19)
    world().reset(rng)
    seen = [world().set_state(stand(world(), plan[0]))]
    np.testing.assert_allclose(seen[0]["joint_pos"], plan[0], atol=1e-12)
    follower.reset(rng)
    verdict = None
    while verdict is None:
        decision = follower.act(seen[-1])
        seen.append(world().step(decision.action).observation)
        verdict = decision.verdict
        assert np.abs(decision.action).max() <= 1
        assert decision.action[-1] == 1
    assert verdict is Verdict.SUCCESS
    assert len(seen) == follower.steps + 1 == 801
    away = np.abs(np.array([o["joint_pos"] for o in seen]) - follower.reference(np.arange(801) / 20))
    assert away.max() < 0.005


def test_without_friction_the_controllers_equation_leaves_no_error() -> None:
    """qdd = omega^2 (g - q) - 2 omega qd between actions: what the action is computed from."""
    spec = replace(world().spec, control_hz=100)
    plan = swing()
    follower = PlanFollower(spec, plan, 40.0 / 19)
    follower.reset(np.random.default_rng(0))
    q, speed, away = plan[0].copy(), np.zeros(7), []
    for step in range(500):
        goal = q + RANGE_RAD * follower.act({"joint_pos": q}).action[:7]
        exact = solve_ivp(
            lambda _, x, goal=goal: np.concatenate([x[7:], OMEGA**2 * (goal - x[:7]) - 2 * OMEGA * x[7:]]),
            (0.0, 0.01), np.concatenate([q, speed]), rtol=1e-9, atol=1e-12,
        ).y[:, -1]  # fmt: skip
        q, speed = exact[:7], exact[7:]
        away.append(q - follower.reference(np.array([(step + 1) / 100]))[0])
    assert np.abs(away).max() < 1e-4


def test_a_follower_that_was_left_behind_fails() -> None:
    plan = swing()
    follower = PlanFollower(world().spec, plan, 40.0 / 19)
    follower.reset(np.random.default_rng(0))
    verdicts = [follower.act({"joint_pos": plan[0]}).verdict for _ in range(follower.steps)]
    assert verdicts == [None] * (follower.steps - 1) + [Verdict.FAILURE]


def test_worlds_and_plans_that_do_not_fit_are_refused() -> None:
    spec, plan = world().spec, swing()
    with pytest.raises(InputError, match="followed with JOINT_POSITION, the world has OSC_POSE"):
        PlanFollower(replace(spec, controller="OSC_POSE"), plan, 1.0)
    with pytest.raises(InputError, match="the plan moves 6 joints, 'panda' has 7"):
        PlanFollower(spec, plan[:, :6], 1.0)
    with pytest.raises(
        InputError, match=r"moves robot0_joint\d at up to .* rad/s, .* let it take \d+ s or more"
    ) as told:
        PlanFollower(spec, plan, 4.0 / 19)
    enough = float(str(told.value).split("let it take ")[1].split(" s")[0])
    follower = PlanFollower(spec, plan, enough / 19)
    speed = np.diff(follower.reference(np.arange(follower.steps) / 20), axis=0) * 20
    assert np.abs(speed).max() <= SPEED_RAD_S
