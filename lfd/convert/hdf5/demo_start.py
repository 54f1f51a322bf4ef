"""Where the replay of a demonstration begins: its model, its first state, and what the controllers remembered there."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lfd.convert.hdf5 import recorded_model
from lfd.convert.hdf5.demo_file import Demo
from lfd.core.errors import EpisodeError
from lfd.core.protocols import WorldState
from lfd.worlds.cameras import load_model
from lfd.worlds.robosuite_world import RobosuiteWorld


@dataclass(frozen=True, kw_only=True)
class DemoStart:
    """A world that stands at the first state of a demonstration."""

    world: RobosuiteWorld
    state: WorldState
    states: Float[np.ndarray, "T _"]
    """The recorded states in the order of the world's model."""
    positions: int
    """Numbers of qpos in them."""
    model: str
    """Which model is used: the recorded one, or today's and what of the recorded one it took over."""
    model_ee_m: float | None
    """Largest distance of a grip site between the recorded model and the one used, over all states [m]."""
    model_objects_m: float | None
    """The same of everything but robots [m]; both are None where the file has no model."""


def start_of(world: RobosuiteWorld, demo: Demo, actions: np.ndarray) -> DemoStart:
    """Give the world the demonstration's model and put it into the first state.

    Raises `EpisodeError` for a demonstration without states, and for states or a model that do not fit the task.
    """
    if demo.states is None:
        raise EpisodeError("it has no dataset 'states'; map its stored observations with [map.NAME] tables")
    world.reset(np.random.default_rng(0))
    fresh = world.get_state()
    today = recorded_model.skeleton(fresh.model_xml)
    xml = _model_xml(demo)
    recorded = None if xml is None else recorded_model.skeleton(xml)
    order = recorded_model.places(recorded, today)
    width = 1 + len(order.qpos) + len(order.qvel)
    if demo.states.shape[1] != width:
        raise EpisodeError(
            f"'states' has {demo.states.shape[1]} columns, {world.spec.task} with {world.spec.robot} has {width}: "
            f"time, {len(order.qpos)} positions, {len(order.qvel)} velocities"
        )
    used_xml, said = _model(xml, recorded, fresh.model_xml, today)
    ee = objects = None
    if recorded is not None:
        used = recorded_model.skeleton(used_xml)
        ee, objects = recorded_model.difference(recorded, used, demo.states, order)
    states = order.todays(demo.states)
    rebuilt = used_xml.rstrip() + "\n"  # another text than the present model's, so that it is built and its memory new
    world.set_state(WorldState(model_xml=rebuilt, sim=fresh.sim, memory={}))
    return DemoStart(
        world=world,
        state=_first(world, states, len(order.qpos), actions[0]),
        states=states,
        positions=len(order.qpos),
        model=said,
        model_ee_m=ee,
        model_objects_m=objects,
    )


def _first(world: RobosuiteWorld, states: np.ndarray, positions: int, action: np.ndarray) -> WorldState:
    """The first state, with what the controllers probably remembered; no file says it.

    robosuite's own collection puts the state into a world that was just built; elsewhere a reset has ended in it. The
    one of both is taken from which the first action leads closer to the second state.
    """
    world.show(states[0])
    built = world.get_state()
    world.settle()
    settled = world.get_state()
    if len(states) == 1:
        return settled

    def away(start: WorldState) -> float:
        world.set_state(start)
        world.step(action)
        reached = world.sim_state()[1 : 1 + positions]  # mjSTATE_INTEGRATION begins with time and qpos
        return float(np.abs(reached - states[1, 1 : 1 + positions]).max())

    return min(settled, built, key=away)


def _model(
    xml: str | None, recorded: recorded_model.Skeleton | None, todays_xml: str, today: recorded_model.Skeleton
) -> tuple[str, str]:
    """The model to use, and what to say of it."""
    if xml is None or recorded is None:
        return todays_xml, "today's; the file has none"
    here = recorded_model.portable(xml)
    if recorded_model.is_todays(recorded, today) and _compiles(here):
        return here, "the recorded one"
    adopted, changed = recorded_model.adopt(todays_xml, recorded)
    return adopted, f"today's; of the recorded one: {', '.join(changed) or 'nothing differs'}"


def _compiles(xml: str) -> bool:
    """Whether MuJoCo compiles a model here: its meshes may be gone, and what is allowed changes with versions."""
    try:
        load_model(xml)
    except ValueError:
        return False
    return True


def _model_xml(demo: Demo) -> str | None:
    """The recorded model: in the file, or in a file of that name beside it."""
    text = demo.model_xml or ""
    if text.lstrip().startswith("<"):
        return text
    name = Path(text).name
    places = [demo.file.parent / name, demo.file.parent / "models" / name] if name else []
    found = next((place for place in places if place.is_file()), None)
    return None if found is None else found.read_text(encoding="utf-8")
