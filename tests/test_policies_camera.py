"""A policy that sees through a camera, from the recording to the evaluation."""

import os
from ctypes.util import find_library

import numpy as np
import pytest

from tests.conftest import ROOT, call_json

if not (find_library("EGL") or find_library("OSMesa") or "CI" in os.environ):
    pytest.skip("offscreen rendering needs libegl1 libgl1, or libosmesa6", allow_module_level=True)


@pytest.mark.slow
def test_a_camera_policy_is_recorded_for_trained_and_evaluated(tmp_path) -> None:
    from lfd.data.frames import load_frames
    from lfd.policies.acting import LearnedPolicy, load_policy
    from lfd.worlds.robosuite_world import make_world

    recordings, dataset, policy, run = (tmp_path / name for name in ("recordings", "dataset", "policy", "run"))
    recipe = ROOT / "datasets" / "lift_panda_camera.toml"
    call_json(["record", str(recipe), "--episodes", "1", "--worlds", "1", "--out", str(recordings)])
    call_json(["convert", str(recordings), "--out", str(dataset)])
    image = str(ROOT / "policies" / "bc_image.toml")
    call_json(["train", image, "--dataset", str(dataset), "--steps", "2", "--out", str(policy)])
    short = ["--episodes", "1", "--worlds", "1"]
    report = call_json(["eval", str(policy), *short, "--out", str(run)])
    assert report["episodes"] == 1

    world = make_world("Lift", "panda", 20)
    world.take_cameras(("agentview",), height=84, width=84)
    seen = world.reset(np.random.default_rng(0))
    acting = LearnedPolicy(policy, world.spec, eyes=[world])
    network, before, after = load_policy(policy)
    frames = load_frames(dataset)
    assert set(frames.columns) == {"observation.state", "action"}, "the policy is not told where the cube is"
    import torch

    picture = torch.from_numpy(world.pictures()["agentview"].copy()).permute(2, 0, 1)[None].float() / 255
    state = torch.tensor(
        [
            [
                seen[n.partition(".")[0]][world.spec.labels[n.partition(".")[0]].index(n.partition(".")[2])]
                for n in frames.names["observation.state"]
            ]
        ]
    )
    expected = after(
        network.select_action(before({"observation.state": state.float(), "observation.images.agentview": picture}))
    )
    np.testing.assert_allclose(acting.act(seen).action, expected[0].numpy(), atol=1e-4)
