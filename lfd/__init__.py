"""Robot learning from demonstration: record, convert, train, run and replay.

The names below are the public surface. Each is imported when it is first used, so `import lfd` loads neither
robosuite nor torch. Stages that share their name with a package (record, convert, train) are imported from it.
"""

from importlib import import_module
from typing import Any

from lfd.worlds.gymnasium_ids import register_when_imported

_PUBLIC = {
    "ArmEnv": "lfd.worlds.gymnasium_env",
    "Decision": "lfd.core.protocols",
    "Episode": "lfd.core.episode",
    "InputError": "lfd.core.errors",
    "LfdError": "lfd.core.errors",
    "Observer": "lfd.core.protocols",
    "Policy": "lfd.core.protocols",
    "VectorWorld": "lfd.worlds.vector_world",
    "World": "lfd.core.protocols",
    "branch": "lfd.worlds.rollout",
    "channel": "lfd.core.channels",
    "episode_rng": "lfd.worlds.rollout",
    "evaluate": "lfd.run.evaluate",
    "load_frames": "lfd.data.frames",
    "make_expert": "lfd.experts.registry",
    "make_world": "lfd.worlds.robosuite_world",
    "read_episode": "lfd.record.episode_file",
    "rollout": "lfd.worlds.rollout",
    "rollouts": "lfd.worlds.rollout",
    "verify": "lfd.convert.verify",
    "verify_replay": "lfd.replay.verify",
    "wilson_interval": "lfd.run.wilson",
}

register_when_imported()

__all__ = sorted(_PUBLIC)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'lfd' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return __all__
