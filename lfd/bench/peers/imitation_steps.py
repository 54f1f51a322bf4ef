"""imitation's behaviour cloning: takes gradient steps when asked to, with its own data loader and training loop.

Arguments: a file of rows (.npz) and the options of `lfd.bench.peers.process.Peer` as JSON.
"""

import json
import sys

import gymnasium
import numpy as np
import torch
from imitation.algorithms.bc import BC  # pyright: ignore[reportMissingImports]
from imitation.data.types import Transitions  # pyright: ignore[reportMissingImports]
from imitation.util import logger  # pyright: ignore[reportMissingImports]
from serving import serve
from stable_baselines3.common.policies import ActorCriticPolicy  # pyright: ignore[reportMissingImports]


def main() -> None:
    """Build the trainer, then wait for numbers of steps."""
    rows, options = np.load(sys.argv[1]), json.loads(sys.argv[2])
    torch.set_num_threads(1)
    seen = np.concatenate([rows["observation.state"], rows["observation.environment_state"]], axis=1)
    count = len(seen)
    spaces = [
        gymnasium.spaces.Box(-np.inf, np.inf, (seen.shape[1],)),
        gymnasium.spaces.Box(-1, 1, (rows["action"].shape[1],)),
    ]
    trainer = BC(
        observation_space=spaces[0],
        action_space=spaces[1],
        rng=np.random.default_rng(0),
        policy=ActorCriticPolicy(*spaces, lambda _: 1e-3, net_arch=list(options["hidden_sizes"])),
        demonstrations=Transitions(seen, rows["action"], np.array([{}] * count), seen, np.zeros(count, bool)),
        batch_size=options["batch_size"],
        custom_logger=logger.configure(None, []),
    )
    serve(lambda steps: trainer.train(n_batches=steps, progress_bar=False))


main()
