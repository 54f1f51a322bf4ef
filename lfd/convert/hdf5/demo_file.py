"""Demonstrations of robosuite and robomimic in HDF5 files, read safely and checked.

Two layouts, which differ in what stands beside the demonstrations:

    data                     env, env_info (JSON), repository_version    robosuite 1.0 to 1.5
                             env_args (JSON), total                      robomimic
    data/demo_1              model_file: the MuJoCo model as XML; num_samples
    data/demo_1/actions      (T, Da)
    data/demo_1/states       (T, 1 + nq + nv): time, qpos, qvel before each action
    data/demo_1/obs/NAME     (T, ...), robomimic

The file is opened in a process of its own, bounded in time and memory (`lfd.convert.hdf5.reading`).
"""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from lfd.convert.hdf5.reading import ask
from lfd.core.errors import EpisodeError, RecordingError, UnknownName

SKIP = "--skip-bad leaves it out"
COUNTS = f"{SKIP}, --trust-rows takes the rows that are there"
ROBOSUITE_HZ = 20
"""Control steps a second that robosuite takes where nothing else is said [Hz]."""


@dataclass(frozen=True, kw_only=True)
class DemoFile:
    """What a file says of all its demonstrations."""

    path: Path
    layout: Literal["robosuite", "robomimic"]
    env_name: str
    """Environment, robosuite's name for it."""
    robots: tuple[str, ...]
    """robosuite's names of the robots; none where the file does not say."""
    controllers: Mapping[str, Any]
    """`controller_configs` as the file has them, in robosuite's form of that time."""
    control_hz: int | None
    """Control steps a second [Hz]; None where the file does not say (see `rate_of`)."""
    version: str
    """Version of robosuite that recorded it; empty where the file does not say."""
    made: str
    """Date and time, ISO 8601; empty where the file does not say."""
    demos: tuple[str, ...]
    """Names of the demonstrations, demo_2 before demo_10."""
    lengths: Mapping[str, int]
    """Rows of each demonstration's actions; 0 where it has none."""
    action_size: int
    """Components of the action in most demonstrations."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    """One demonstration of T rows, checked."""

    file: Path
    name: str
    actions: Float[np.ndarray, "T Da"]
    states: Float[np.ndarray, "T _"] | None
    """Time [s], qpos and qvel of the simulator before each action."""
    rewards: Float[np.ndarray, "T"] | None
    dones: Float[np.ndarray, "T"] | None
    obs: Mapping[str, np.ndarray]
    """Name to the observation before each action, (T, ...), as it is stored."""
    model_xml: str | None
    """The MuJoCo model, or the name of a file with it."""

    def __len__(self) -> int:
        """Number of rows T."""
        return len(self.actions)


def read_file(path: Path, *, trust_rows: bool = False) -> DemoFile:
    """What a file says of all its demonstrations, without reading their arrays.

    Raises `RecordingError` for a file that is damaged, no HDF5, or neither robosuite's nor robomimic's, or when its
    `total` is not the number of rows, unless `trust_rows`.
    """
    content = ask(path, None, None).content
    said, outlines = content["attributes"], sorted(content["demos"], key=lambda outline: _natural(outline["name"]))
    if not outlines:
        raise RecordingError(f"{path}: its group data holds no demonstration")
    layout = "robomimic" if "env_args" in said else "robosuite" if "env" in said else None
    if layout is None:
        raise RecordingError(f"{path}: data has no attribute env_args (robomimic) and no env (robosuite)")
    lengths = {outline["name"]: (outline["shape"] or [0])[0] for outline in outlines}
    rows = sum(lengths.values())
    if not trust_rows and said.get("total", rows) != rows:
        raise RecordingError(
            f"{path}: data's attribute total says {said['total']} rows, its {len(outlines)} demonstrations have "
            f"{rows}; --trust-rows takes the rows that are there"
        )
    key = "env_args" if layout == "robomimic" else "env_info"
    args = _parsed(path, key, said.get(key, "{}"))
    options = args.get("env_kwargs", args)  # robosuite's are flat, and so are those of older robomimic
    options = options if isinstance(options, dict) else {}
    robots = options.get("robots", args.get("robots", ()))
    controllers = options.get("controller_configs") or {}
    sizes = Counter(outline["shape"][1] for outline in outlines if len(outline["shape"] or ()) == 2)
    return DemoFile(
        path=path,
        layout=layout,
        env_name=str(said["env"] if layout == "robosuite" else args.get("env_name") or said.get("env_name", "")),
        robots=(robots,) if isinstance(robots, str) else tuple(str(robot) for robot in robots),
        controllers=controllers[0] if isinstance(controllers, list) else controllers,
        control_hz=_rate(path, options.get("control_freq")),
        version=str(said.get("repository_version", args.get("env_version", ""))),
        made=_made(str(said.get("date", "")), str(said.get("time", ""))),
        demos=tuple(outline["name"] for outline in outlines),
        lengths=lengths,
        action_size=sizes.most_common(1)[0][0] if sizes else 0,
    )


def read_demo(file: DemoFile, name: str, *, obs: Sequence[str] | None = None, trust_rows: bool = False) -> Demo:
    """Demonstration `name` with the observations called `obs` (None: all).

    Raises `EpisodeError` when it cannot be read or is no episode: no actions, no rows, lengths that differ, NaN,
    actions of another size than in the other demonstrations, or `num_samples` that differs from the rows, unless
    `trust_rows`. Raises `UnknownName` for a name that is not in the file.
    """
    if name not in file.demos:
        raise UnknownName(f"demonstration in {file.path}:", name, file.demos)
    where = f"{file.path} {name}"
    try:
        answer = ask(file.path, name, obs)
    except RecordingError as error:  # of one demonstration; others may be whole
        raise EpisodeError(f"{error}; {SKIP}") from error
    arrays, said = answer.arrays, answer.content["attributes"]
    if "actions" not in arrays:
        raise EpisodeError(f"{where} has no dataset 'actions'; it holds {', '.join(answer.content['holds'])}; {SKIP}")
    _check(where, arrays, file.action_size)
    rows = len(arrays["actions"])
    if not trust_rows and said.get("num_samples", rows) != rows:
        raise EpisodeError(
            f"{where}: its attribute num_samples says {said['num_samples']}, 'actions' has {rows} rows; {COUNTS}"
        )
    plain = {key: np.asarray(arrays[key], dtype=np.float64) for key in arrays if not key.startswith("obs/")}
    return Demo(
        file=file.path,
        name=name,
        actions=plain["actions"],
        states=plain.get("states"),
        rewards=plain.get("rewards"),
        dones=plain.get("dones"),
        obs={key.removeprefix("obs/"): values for key, values in arrays.items() if key.startswith("obs/")},
        model_xml=said.get("model_file"),
    )


def rate_of(file: DemoFile, demo: Demo) -> int:
    """Control steps a second [Hz]: as the file says, else by the clock in the states, else robosuite's default."""
    if file.control_hz is not None:
        return file.control_hz
    if demo.states is None or len(demo) < 2:
        return ROBOSUITE_HZ
    step = float(np.median(np.diff(demo.states[:, 0])))
    if step <= 0 or round(1 / step) < 1:
        raise EpisodeError(f"{file.path} {demo.name}: the clock in 'states' does not run ({step:.4f} s a row); {SKIP}")
    return round(1 / step)


def _check(where: str, arrays: Mapping[str, np.ndarray], action_size: int) -> None:
    actions = arrays["actions"]
    dimensions = {"actions": 2, "states": 2, "rewards": 1, "dones": 1}
    for key, values in arrays.items():
        if values.ndim != dimensions.get(key, values.ndim):
            raise EpisodeError(
                f"{where}: '{key}' has the shape {values.shape}, expected {dimensions[key]} axes; {SKIP}"
            )
    if len(actions) == 0:
        raise EpisodeError(f"{where}: 'actions' has no rows; {SKIP}")
    if actions.shape[1] != action_size:
        raise EpisodeError(
            f"{where}: 'actions' has {actions.shape[1]} components, other demonstrations of the file have "
            f"{action_size}; {SKIP}, or convert them into datasets of their own"
        )
    for key, values in arrays.items():
        if len(values) != len(actions):
            raise EpisodeError(f"{where}: '{key}' has {len(values)} rows, 'actions' has {len(actions)}; {SKIP}")
        finite = np.isfinite(values).reshape(len(values), -1).all(axis=1) if values.dtype.kind == "f" else np.True_
        if not np.all(finite):
            raise EpisodeError(f"{where}: '{key}' is not finite in row {int(np.argmin(finite))}; {SKIP}")


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts demo_2 before demo_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _parsed(path: Path, key: str, text: Any) -> dict[str, Any]:
    try:
        args = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise RecordingError(
            f"{path}: data's attribute {key} is no JSON ({error}); it must name the environment"
        ) from error
    if not isinstance(args, dict):
        raise RecordingError(f"{path}: data's attribute {key} is {type(args).__name__}, expected a JSON object")
    return args


def _made(date: str, time: str) -> str:
    """robosuite writes 9-4-2020 and 14:16:5."""
    numbers = re.fullmatch(r"(\d+)-(\d+)-(\d+) (\d+):(\d+):(\d+)", f"{date} {time}")
    if numbers is None:
        return ""
    month, day, year, hour, minute, second = map(int, numbers.groups())
    return f"{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}"


def _rate(path: Path, said: Any) -> int | None:
    if said is None:
        return None
    if not isinstance(said, (int, float)) or not 0 < said <= 10_000 or said != int(said):
        raise RecordingError(f"{path}: control_freq is {said!r}, expected a whole number of control steps a second")
    return int(said)
