"""HDF5 files for tests: small ones of both layouts, and damaged ones made of them."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

DATA = Path(__file__).parent / "data" / "hdf5"
DAMAGED = DATA / "damaged"
LIFT = DATA / "lift_panda_v1.4.0.hdf5"
STACK = DATA / "stack_panda_v1.0.0.hdf5"
REACHING = DATA / "reaching_v1.3.1.hdf5"
ENV_ARGS = {"env_name": "Lift", "type": 1, "env_kwargs": {"robots": ["Panda"], "control_freq": 20}}
ROWS = 12


def opened(path: Path, mode: str = "r", **options: Any) -> Any:
    """An open HDF5 file; h5py's own types say less than the tests know."""
    return h5py.File(path, mode, **options)


def small_file(path: Path, layout: str = "robomimic", *, chunked: bool = False, latest: bool = False) -> Path:
    """Two demonstrations of 12 rows, random numbers."""
    rng = np.random.default_rng(0)
    options = {"compression": "gzip", "chunks": True, "shuffle": True} if chunked else {}
    with opened(path, "w", **({"libver": "latest"} if latest else {})) as file:
        data = file.create_group("data")
        if layout == "robosuite":
            data.attrs["env"] = "Lift"
            data.attrs["env_info"] = '{"robots": "Panda"}'
            data.attrs["repository_version"] = "1.4.0"
        else:
            data.attrs["env_args"] = json.dumps(ENV_ARGS)
            data.attrs["total"] = 2 * ROWS
        for name in ("demo_1", "demo_2"):
            demo = data.create_group(name)
            demo.attrs["model_file"] = "<mujoco/>" * 20
            demo.attrs["num_samples"] = ROWS
            demo.create_dataset("actions", data=rng.normal(size=(ROWS, 7)), **options)
            demo.create_dataset("states", data=rng.normal(size=(ROWS, 32)), **options)
            if layout == "robomimic":
                demo["rewards"], demo["dones"] = np.zeros(ROWS), np.zeros(ROWS, dtype=bool)
                demo.create_dataset("obs/a", data=rng.normal(size=(ROWS, 3)), **options)
                demo.create_dataset("obs/b", data=rng.normal(size=(ROWS, 4)), **options)
        if layout == "robomimic":
            file["mask/train"] = np.array([b"demo_1"])
    return path


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """A file cut off, with flipped bits, with blocks overwritten or copied elsewhere, or garbage."""
    made, size = bytearray(data), len(data)
    kind = rng.integers(6)
    if kind == 0:
        return data[: rng.integers(size)]
    if kind == 1:
        return (data[: rng.integers(64)] if rng.random() < 0.5 else b"") + rng.bytes(int(rng.integers(4000)))
    for _ in range(rng.integers(1, 30 if kind == 2 else 6)):
        at = int(rng.integers(size))
        if kind == 2:
            made[at] ^= 1 << int(rng.integers(8))
        elif kind == 3:  # where the superblock and the first headers are
            made[at % 3000] = int(rng.integers(256))
        else:
            length = min(int(rng.integers(1, 600)), size - at)
            begin = int(rng.integers(size - length + 1))
            fill = (rng.bytes(length), bytes(length), b"\xff" * length)[rng.integers(3)]
            made[at : at + length] = data[begin : begin + length] if kind == 4 else fill
    return bytes(made)
