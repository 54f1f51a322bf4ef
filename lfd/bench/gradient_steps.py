"""Gradient steps of behaviour cloning a second: ours, a bare loop, LeRobot's loop, and those of peers.

All train a multilayer perceptron of the same hidden layers on the same rows with the same batch, in one thread. The
bare loop has the rows in memory and does what a step of ours does: draw, forward, backward, clip, AdamW.
"""

from pathlib import Path
from typing import Any

import torch
from torch import nn

from lfd.bench.loading import endless, lerobot_dataset
from lfd.bench.turns import Side, by_cpu_time
from lfd.data.frames import Frames, load_frames
from lfd.policies.registry import make_policy
from lfd.train.descent import Descent
from lfd.train.recipe import TrainRecipe
from lfd.train.training_data import TrainingData

CLIP, RATE, DECAY = 10.0, 1e-3, 1e-2
FOREVER = 10**9


def ours(root: Path, hidden_sizes: tuple[int, ...], batch_size: int) -> Side:
    """`lfd train`'s own loop on the dataset `root`."""
    frames = load_frames(root)
    policy, before, _ = _policy(frames, hidden_sizes)
    recipe = TrainRecipe(
        steps=FOREVER, batch_size=batch_size, learning_rate=RATE, weight_decay=DECAY, grad_clip=CLIP, seed=0
    )
    data = TrainingData(frames, policy.config, before, recipe)
    descent = Descent(policy, data.batch, data.train, recipe)
    return lambda steps: by_cpu_time(lambda: descent.advance(descent.step + steps))(1)


def bare(root: Path, hidden_sizes: tuple[int, ...], batch_size: int) -> Side:
    """The limit: nothing but what a gradient step needs, in plain torch."""
    frames = load_frames(root)
    seen = torch.cat([rows for name, rows in frames.columns.items() if name != "action"], dim=1)
    seen, actions = (seen - seen.mean(0)) / seen.std(0), frames.columns["action"]
    sizes = (seen.shape[1], *hidden_sizes)
    layers: list[nn.Module] = []
    for wide, narrow in zip(sizes, hidden_sizes, strict=False):
        layers += [nn.Linear(wide, narrow), nn.ReLU()]
    net = nn.Sequential(*layers, nn.Linear(sizes[-1], actions.shape[1]))
    params = list(net.parameters())
    optimizer = torch.optim.AdamW(params, lr=RATE, weight_decay=DECAY, fused=True)
    orders = iter(())

    def step() -> None:
        nonlocal orders
        index = next(orders, None)
        if index is None or len(index) < batch_size:
            orders = iter(torch.randperm(len(seen)).split(batch_size))
            index = next(orders)
        loss = nn.functional.mse_loss(net(seen[index]), actions[index])
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(params, CLIP)
        optimizer.step()

    return by_cpu_time(step)


def lerobot(root: Path, hidden_sizes: tuple[int, ...], batch_size: int) -> Side:
    """The loop of `lerobot-train` without its logs, on the same policy."""
    from accelerate import Accelerator
    from lerobot.scripts.lerobot_train import update_policy
    from lerobot.utils.logging_utils import AverageMeter, MetricsTracker

    frames = load_frames(root)
    policy, before, _ = _policy(frames, hidden_sizes)
    dataset = lerobot_dataset(root, {}, frames.fps)
    preset = policy.config.get_optimizer_preset()
    accelerator: Any = Accelerator(step_scheduler_with_optimizer=False, cpu=True)
    policy, optimizer = accelerator.prepare(policy, preset.build(policy.get_optim_params()))
    names = ("loss", "grad_norm", "lr", "update_s", "dataloading_s")
    meters = {name: AverageMeter(name, ":.3f") for name in names}
    tracker = MetricsTracker(batch_size, len(dataset), dataset.num_episodes, meters, accelerator=accelerator)
    batches = endless(dataset, batch_size)

    def step() -> None:
        batch = before(next(batches))
        update_policy(tracker, policy, batch, optimizer, preset.grad_clip_norm, accelerator=accelerator)

    return by_cpu_time(step)


def _policy(frames: Frames, hidden_sizes: tuple[int, ...]) -> Any:
    torch.manual_seed(0)
    return make_policy({"type": "bc_mlp", "hidden_sizes": list(hidden_sizes)}, frames, "cpu", "bench")
