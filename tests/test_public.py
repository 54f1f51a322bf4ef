import subprocess
import sys

import pytest

import lfd

PUBLIC = [
    "ArmEnv", "Decision", "Episode", "InputError", "LfdError", "Observer", "Policy", "VectorWorld", "World", "branch",
    "channel", "episode_rng", "evaluate", "load_frames", "make_expert", "make_world", "read_episode", "rollout",
    "rollouts", "verify", "verify_replay", "wilson_interval",
]  # fmt: skip


def test_the_public_surface_is_pinned() -> None:
    assert lfd.__all__ == PUBLIC
    for name in PUBLIC:
        assert getattr(lfd, name).__doc__


def test_unknown_names_list_the_known() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'rolout'; it has ArmEnv, Decision, .*rollout"):
        lfd.rolout  # noqa: B018


def test_importing_lfd_loads_nothing_heavy() -> None:
    code = "import sys, lfd; assert not {'numpy', 'torch', 'robosuite', 'lerobot'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
