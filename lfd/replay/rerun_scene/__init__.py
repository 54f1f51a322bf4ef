"""Clips in Rerun. This package and `rerun_live` are the only ones that import rerun.

Meshes are logged once, without time; what moves are the transforms of their bodies, sent as columns.
"""

from lfd.replay.rerun_scene.blueprints import scene_view
from lfd.replay.rerun_scene.models import body_name, log_shapes
from lfd.replay.rerun_scene.outputs import replay

__all__ = ["body_name", "log_shapes", "replay", "scene_view"]
