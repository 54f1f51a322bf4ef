"""Demonstrations of an arm in scenes, as inverse RL takes them: from recordings or from a LeRobot dataset.

What is learned from is the recorded motion of the joints, not the plan behind it. It is resampled to the planner's
waypoints, so that demonstrations and plans are counted alike.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.artifact import read_manifest, sha256
from lfd.core.errors import InputError, RecordingError
from lfd.core.recipe import build
from lfd.loops.cup_scenes import Placement
from lfd.loops.plan_demonstrations import PlanRecipe
from lfd.planning.arm_model import load_arm
from lfd.planning.arm_planner import ArmPlanner
from lfd.planning.kinematics import Arm
from lfd.record.episode_file import SUFFIX, read_episode, recipe_in, recordings_in

SAME = ("robot", "waypoints", "duration_s", "smoothness")
"""What all demonstrations of a source must have in common."""
PREFIX = "joint_pos."
"""What names of the arm's joints begin with in a dataset."""
TYPE = "`lfd plan datasets/cup_panda.toml --out DIR` records plans that keep their scenes; give that DIR"
"""What to type for demonstrations that can be learned from."""


@dataclass(frozen=True)
class Demonstration:
    """One demonstration in its scene."""

    source: str
    """The recording that it comes from."""
    placement: Placement
    trajectory: Float[np.ndarray, "T D"]
    """Joint positions at the planner's waypoints [rad]."""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Demonstrations of one arm."""

    recipe: PlanRecipe
    """What they were planned with. Its weights are the demonstrator's: nothing may learn from them."""
    demonstrations: tuple[Demonstration, ...]
    parents: Mapping[str, str]
    """Path of the source to its hash."""

    @cached_property
    def arm(self) -> Arm:
        """The arm that demonstrated."""
        return load_arm(self.recipe.robot)

    @cached_property
    def scenes(self) -> list[tuple[Placement, Float[np.ndarray, "N T D"]]]:
        """Each scene with the demonstrations in it, in the order of their first."""
        found: dict[Placement, list[np.ndarray]] = {}
        for one in self.demonstrations:
            found.setdefault(one.placement, []).append(one.trajectory)
        return [(placement, np.array(trajectories)) for placement, trajectories in found.items()]

    def planner(self, placement: Placement, features: Sequence[str]) -> ArmPlanner:
        """The planner in a scene, for some features."""
        return ArmPlanner(
            self.arm,
            placement.scene(self.arm),
            features=tuple(features),
            waypoints=self.recipe.waypoints,
            duration_s=self.recipe.duration_s,
            smoothness=self.recipe.smoothness,
        )

    def counts(self, features: Sequence[str]) -> Float[np.ndarray, "N K"]:
        """Feature counts of each demonstration."""
        rows = [self.planner(d.placement, features).features(d.trajectory[None])[0] for d in self.demonstrations]
        return np.array(rows)


def load_evidence(source: Path) -> Evidence:
    """The demonstrations in recordings, a folder of them, or a LeRobot dataset that was converted from such.

    Raises `InputError` for recordings that keep no scene, that were planned with other settings, and for a dataset
    whose recordings are gone; and what reading them raises.
    """
    if (source / "meta" / "info.json").is_file():
        paths, motions = _of_dataset(source)
        recipes = [_recipe(path, source) for path in paths]
    else:
        if source.is_dir() and not any(source.rglob(f"*{SUFFIX}")):
            raise InputError(
                f"{source} is neither recordings of plans nor a dataset of them: it holds no {SUFFIX} file and no "
                f"meta/info.json; {TYPE}"
            )
        paths = recordings_in([source])
        # One by one: the first that keeps no scene ends it, before all are read.
        read = [(_of_recording(path, source), _recipe(path, source)) for path in paths]
        motions, recipes = [motion for motion, _ in read], [recipe for _, recipe in read]
    for path, (recipe, _) in zip(paths, recipes, strict=True):
        for key in SAME:
            if getattr(recipe, key) != getattr(recipes[0][0], key):
                raise InputError(
                    f"{path} was planned with {key} = {getattr(recipe, key)}, {paths[0]} with "
                    f"{getattr(recipes[0][0], key)}; learn from recordings of one kind"
                )
    waypoints = recipes[0][0].waypoints
    return Evidence(
        recipe=recipes[0][0],
        demonstrations=tuple(
            Demonstration(str(path), placement, resampled(motion, waypoints))
            for path, (_, placement), motion in zip(paths, recipes, motions, strict=True)
        ),
        parents={str(source): sha256(source)},
    )


def resampled(motion: Float[np.ndarray, "N D"], waypoints: int) -> Float[np.ndarray, "T D"]:
    """A motion that was seen at equal distances in time at `waypoints` times, the first and the last among them."""
    seen, wanted = np.linspace(0.0, 1.0, len(motion)), np.linspace(0.0, 1.0, waypoints)
    return np.stack([np.interp(wanted, seen, joint) for joint in motion.T], axis=1)


def _recipe(path: Path, source: Path) -> tuple[PlanRecipe, Placement]:
    """What a recording of `source` was planned with, and its scene."""
    tables: dict[str, Any] = recipe_in(path)
    if "plan" not in tables or "scene" not in tables:
        whose = "" if path == source else f"{source} is neither recordings of plans nor a dataset of them: "
        raise InputError(f"{whose}{path} keeps no scene to plan in; {TYPE}")
    recipe = build(PlanRecipe, tables["plan"], f"{path} [plan]")
    return recipe, Placement.of(tables["scene"], f"{path} [scene]")


def _of_recording(path: Path, source: Path) -> Float[np.ndarray, "N D"]:
    try:
        return np.array(read_episode(path).observations["joint_pos"])
    except RecordingError as error:
        if path == source:
            raise
        raise RecordingError(f"{source} is not all recordings of plans: {error}; {TYPE}") from error


def _of_dataset(root: Path) -> tuple[list[Path], list[Float[np.ndarray, "N D"]]]:
    """The recordings that a dataset was converted from, and the motions that it holds."""
    from lfd.data.frames import load_frames

    manifest = read_manifest(root)
    if manifest is None:
        raise InputError(f"{root} has no manifest.json, which leads to the scenes; give the recordings instead")
    paths = [_found(Path(parent), root) for parent in manifest["parents"]]
    frames = load_frames(root, images=False)
    columns = [i for i, name in enumerate(frames.names["observation.state"]) if name.startswith(PREFIX)]
    if not columns:
        raise InputError(f'{root} has no joint positions; convert with "joint_pos" in the [convert] table\'s state')
    states = frames.columns["observation.state"].numpy()[:, columns].astype(float)
    begins, ends = (rows.tolist() for rows in frames.episodes)
    if len(begins) != len(paths):
        raise InputError(
            f"{root} has {len(begins)} episodes from {len(paths)} recordings, so that their scenes are not known; give "
            "the recordings instead"
        )
    return paths, [states[begin:end] for begin, end in zip(begins, ends, strict=True)]


def _found(recording: Path, root: Path) -> Path:
    places = (Path(), *root.resolve().parents)
    path = next((place / recording for place in places if (place / recording).is_file()), None)
    if path is None:
        raise InputError(
            f"the scenes of {root} are in the recording {recording}, which is gone; bring it back, or give recordings"
        )
    return path
