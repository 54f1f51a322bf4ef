"""robomimic's behaviour cloning: takes gradient steps when asked to, with its own data loader and training epoch.

Arguments: a file of robomimic's (.hdf5) and the options of `lfd.bench.peers.process.Peer` as JSON.
"""

import json
import sys

import torch
from robomimic.algo import algo_factory  # pyright: ignore[reportMissingImports]
from robomimic.config import config_factory  # pyright: ignore[reportMissingImports]
from robomimic.utils import file_utils, obs_utils, train_utils  # pyright: ignore[reportMissingImports]
from serving import serve
from torch.utils.data import DataLoader

INPUTS = ["state", "object"]


def main() -> None:
    """Build what `robomimic/scripts/train.py` builds, then wait for numbers of steps."""
    path, options = sys.argv[1], json.loads(sys.argv[2])
    torch.set_num_threads(1)
    config = config_factory("bc")
    with config.values_unlocked():
        config.train.data = path
        config.train.batch_size = options["batch_size"]
        config.algo.actor_layer_dims = tuple(options["hidden_sizes"])
        config.observation.modalities.obs.low_dim = INPUTS
    obs_utils.initialize_obs_utils_with_config(config)
    shapes = file_utils.get_shape_metadata_from_dataset(path, all_obs_keys=INPUTS)
    device = torch.device("cpu")
    model = algo_factory("bc", config, shapes["all_shapes"], ac_dim=shapes["ac_dim"], device=device)
    train, _ = train_utils.load_data_for_training(config, obs_keys=INPUTS)
    loader = DataLoader(train, batch_size=config.train.batch_size, shuffle=True, drop_last=True)
    serve(lambda steps: train_utils.run_epoch(model, loader, epoch=1, num_steps=steps))


main()
