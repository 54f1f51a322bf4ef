"""Stored observations of a demonstration as samples, for the mapping of a recipe: no simulator is needed.

An entry's `topic` names a dataset of the demonstration: `obs/robot0_eef_pos`, or `robot0_eef_pos` for short; `actions`,
`states`, `rewards` and `dones` stand beside `obs`. Its `field` is empty or a part, `data[0:3]`. Row t is measured at
t / control rate.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from lfd.convert.foreign.field_path import Step
from lfd.convert.foreign.mapping import QUATERNION, MapEntry, MapRecipe
from lfd.convert.foreign.sampled_frames import frames_of_samples
from lfd.convert.foreign.samples import Samples
from lfd.convert.frames import EpisodeFrames, Pictures
from lfd.convert.hdf5.demo_file import Demo, DemoFile, rate_of, read_demo
from lfd.core.errors import RecipeError, UnknownName
from lfd.core.rotations import wxyz_from_xyzw

BESIDE_OBS = ("actions", "states", "rewards", "dones")
OBS = "obs/"


def frames_of_demo(file: DemoFile, name: str, recipe: MapRecipe, *, trust_rows: bool = False) -> list[EpisodeFrames]:
    """The episodes that a recipe's mapping makes of demonstration `name`: one, or the pieces between its gaps.

    Raises what `read_demo` raises, `UnknownName` for a dataset that it does not have, and what `frames_of_samples`
    raises for numbers that cannot be right.
    """
    topics = (entry.topic for entry in recipe.entries.values())
    wanted = [topic.removeprefix(OBS) for topic in topics if topic not in BESIDE_OBS]
    demo = read_demo(file, name, obs=wanted, trust_rows=trust_rows)
    about = {"task": file.env_name, "robots": list(file.robots), "control_hz": rate_of(file, demo)}
    return frames_of_samples(
        recipe, f"{file.path.name} {name}", lambda entry: samples_of_demo(file, demo, entry), about=about
    )


def samples_of_demo(file: DemoFile, demo: Demo, entry: MapEntry) -> Samples:
    """What the dataset `entry.topic` of a demonstration holds.

    Quaternions, x y z w in these files, come as w x y z. Pictures are arrays of bytes, (T, H, W, 3).

    Raises `UnknownName` for a dataset that it does not have, `RecipeError` for a field that is no part of a row.
    """
    arrays = {f"{OBS}{key}": values for key, values in demo.obs.items()} | {
        key: values for key in BESIDE_OBS if (values := getattr(demo, key)) is not None
    }
    key = entry.topic if entry.topic in arrays else f"{OBS}{entry.topic}"
    if key not in arrays:
        raise UnknownName(f"dataset in {demo.file} {demo.name}:", entry.topic, arrays)
    where = f"{demo.file.name} {demo.name}, dataset {key}"
    rows = arrays[key]
    times_ns = np.round(np.arange(len(rows)) * (1e9 / rate_of(file, demo))).astype(np.int64)
    if rows.ndim == 4 and rows.dtype == np.uint8 and rows.shape[3] == 3:
        return Samples(where=where, times_ns=times_ns, pictures=_pictures(rows))
    flat = rows.reshape(len(rows), -1)
    part = flat[:, _columns(entry.path(where), where)]
    values = part if part.dtype == bool else part.astype(np.float64)
    names: tuple[str, ...] = ()
    if "quat" in key and flat.shape[1] == part.shape[1] == 4:
        values, names = wxyz_from_xyzw(values), QUATERNION
    return Samples(where=where, times_ns=times_ns, values=values, names=names)


def _columns(path: Sequence[Step], where: str) -> slice:
    """Which numbers of a row a field means."""
    match path:
        case () | ("data",):
            return slice(None)
        case ("data", int(index)):
            return slice(index, index + 1)
        case ("data", slice() as part):
            return part
    raise RecipeError(f"{where} holds plain numbers: leave field out, or write a part of a row such as data[0:3]")


def _pictures(rows: UInt8[np.ndarray, "T H W 3"]) -> Pictures:
    shape = rows.shape[1:]

    def decode(data: bytes) -> UInt8[np.ndarray, "H W 3"]:
        return np.frombuffer(data, np.uint8).reshape(shape)

    return Pictures([row.tobytes() for row in rows], decode)
