"""imitation's maximum causal entropy IRL on a finite MDP, with a reward linear in features.

Arguments: the problem (.npz, written by `lfd.bench.irl_peer`), and where to write what was learned (.npz).
"""

import sys
import time
from typing import Any

import numpy as np
import torch
from imitation.algorithms.mce_irl import MCEIRL  # pyright: ignore[reportMissingImports]
from imitation.data.types import Trajectory  # pyright: ignore[reportMissingImports]
from imitation.rewards.reward_nets import BasicRewardNet  # pyright: ignore[reportMissingImports]
from imitation.util import logger  # pyright: ignore[reportMissingImports]
from seals.base_envs import TabularModelPOMDP  # pyright: ignore[reportMissingImports]


def _demonstrations(given: Any) -> Any:
    """How often the expert is in each state, T + 1 of them, if the problem has that, else its trajectories."""
    if "visits" in given:
        return given["visits"]
    pairs = zip(given["states"], given["actions"], strict=True)
    return [Trajectory(obs=states, acts=actions, infos=None, terminal=True) for states, actions in pairs]


def main() -> None:
    """Train from w = 0 in double precision until the gradient's length is at most the tolerance, or steps run out."""
    given = np.load(sys.argv[1])
    torch.set_num_threads(1)
    features = given["features"]
    env = TabularModelPOMDP(
        transition_matrix=given["transitions"],
        observation_matrix=features,
        reward_matrix=np.zeros(len(features)),
        horizon=int(given["horizon"]),
        initial_state_dist=given["initial"],
    )
    net = BasicRewardNet(env.observation_space, env.action_space, use_action=False, hid_sizes=()).double()
    for parameter in net.parameters():
        torch.nn.init.zeros_(parameter)
    trainer = MCEIRL(
        _demonstrations(given),
        env,
        net,
        rng=np.random.default_rng(0),
        optimizer_kwargs={"lr": float(given["rate"])},
        linf_eps=0.0,
        grad_l2_eps=float(given["tolerance"]),
        log_interval=None,
        custom_logger=logger.configure(None, []),
    )
    began = time.process_time()
    trainer.train(max_iter=int(given["most"]))
    seconds = time.process_time() - began
    parameters = list(net.parameters())
    np.savez(
        sys.argv[2],
        policy=trainer.policy.pi,
        seconds=seconds,
        iterations=int(trainer.optimizer.state[parameters[0]]["step"]),
        gradient=float(torch.cat([parameter.grad.reshape(-1) for parameter in parameters]).norm()),
    )


main()
