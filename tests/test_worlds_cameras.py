import os
import subprocess
import sys
from ctypes.util import find_library

import mujoco
import numpy as np
import pytest

from lfd.core.errors import InputError, SimulationError, UnknownName
from lfd.worlds.cameras import LEFT_OUT, Cameras, load_model, simplify
from lfd.worlds.environments import make_environment
from lfd.worlds.robosuite_world import INTEGRATION
from lfd.worlds.robots import load_robot
from lfd.worlds.tasks import load_task

NAMES = ("agentview", "robot0_eye_in_hand")
if not (find_library("EGL") or find_library("OSMesa") or "CI" in os.environ):
    pytest.skip("offscreen rendering needs libegl1 libgl1, or libosmesa6", allow_module_level=True)


@pytest.fixture(scope="module")
def start(lift_world):
    lift_world.reset(np.random.default_rng(0))
    return lift_world.get_state()


@pytest.fixture(scope="module")
def cameras(start):
    made = Cameras(start.model_xml, NAMES, height=84, width=84)
    yield made
    made.close()


@pytest.fixture(scope="module")
def robosuites_picture(start):
    """Draws `start` as robosuite does."""
    env = make_environment(load_task("Lift"), load_robot("panda"), 20, has_offscreen_renderer=True)
    env.reset_from_xml_string(start.model_xml)
    mujoco.mj_setState(env.sim.model._model, env.sim.data._data, np.array(start.sim), INTEGRATION)
    mujoco.mj_forward(env.sim.model._model, env.sim.data._data)

    def picture(name: str, size: int) -> np.ndarray:
        env.sim._render_context_offscreen.gl_ctx.make_current()  # robosuite assumes that nobody else draws
        return env.sim.render(camera_name=name, height=size, width=size)[::-1]

    yield picture
    env.close()


@pytest.mark.parametrize("size", [84, 256])
def test_pictures_are_robosuites_within_1_of_255(size, start, robosuites_picture) -> None:
    cameras = Cameras(start.model_xml, NAMES, height=size, width=size)
    for name, picture in cameras.render(start.sim).items():
        assert picture.shape == (size, size, 3)
        assert picture.dtype == np.uint8
        assert np.abs(picture - robosuites_picture(name, size).astype(float)).mean() <= 1
    cameras.close()


def test_the_same_state_gives_the_same_pixels(cameras, start, lift_world) -> None:
    first = cameras.render(start.sim)
    lift_world.set_state(start)
    for _ in range(5):
        lift_world.step(np.array([1.0, 0, 0, 0, 0, 0, 0]))
    moved = cameras.render(lift_world.sim_state())
    again = cameras.render(start.sim)
    other = Cameras(start.model_xml, NAMES, height=84, width=84)  # two live side by side
    for name in NAMES:
        assert (first[name] == again[name]).all()
        assert (first[name] == other.render(start.sim)[name]).all()
        assert (first[name] != moved[name]).any()
    other.close()


def test_leaving_geoms_out_does_not_change_a_picture(start) -> None:
    """Beyond the reflections of what is outside the picture, which are a hundredth of it."""
    cameras = Cameras(start.model_xml, ["frontview", *NAMES], height=64, width=96)
    lean = cameras.render(start.sim)
    assert (cameras._model.geom_group == LEFT_OUT).sum() > 20
    cameras._model.geom_aabb[:, 3:] = 100  # in every camera's view
    for name, picture in cameras.render(start.sim).items():
        assert np.abs(picture - lean[name].astype(float)).mean() < 0.1
    assert (cameras._model.geom_group != LEFT_OUT).all()


def test_follow_draws_a_bigger_cube_bigger(start) -> None:
    cameras = Cameras(start.model_xml, ["agentview"], height=128, width=128)
    model = load_model(start.model_xml)

    def red() -> int:
        picture = cameras.render(start.sim)["agentview"].astype(int)
        return int((picture[..., 0] > 2 * picture[..., 1]).sum())

    before = red()
    cameras.follow(model)
    assert red() == before
    model.geom("cube_g0_vis").size[:] *= 2
    cameras.follow(model)
    assert red() > 2.5 * before


def test_follow_and_render_refuse_another_model(cameras) -> None:
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(InputError, match="make new Cameras"):
        cameras.follow(other)
    with pytest.raises(SimulationError, match=r"the state has \(3,\) numbers"):
        cameras.render(np.zeros(3))


def test_wrong_names_sizes_and_closed_cameras_are_errors(start) -> None:
    with pytest.raises(UnknownName, match=r"unknown camera 'agent'; known: agentview, birdview, .* Did you mean"):
        Cameras(start.model_xml, ["agent"], height=84, width=84)
    with pytest.raises(InputError, match="0 x 84 pixels"):
        Cameras(start.model_xml, NAMES, height=0, width=84)
    cameras = Cameras(start.model_xml, NAMES, height=8, width=8)
    cameras.close()
    with pytest.raises(SimulationError, match="closed"):
        cameras.render(start.sim)


def gl_fails(variable: str, value: str) -> str:
    """What starting OpenGL says in a process of its own, whose environment is changed once MuJoCo is there."""
    code = f"""
import os
from lfd.core.errors import SimulationError
from lfd.worlds.cameras import start_gl
os.environ[{variable!r}] = {value!r}
try:
    start_gl(8, 8)
except SimulationError as error:
    print(error)
"""
    clean = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=clean)
    return done.stdout


@pytest.mark.skipif(find_library("OSMesa") is not None, reason="OSMesa is installed here")
def test_a_missing_library_is_named_with_its_package() -> None:
    text = gl_fails("MUJOCO_GL", "osmesa")
    assert text == (
        "cameras need a library for offscreen rendering, none was found. On Debian or Ubuntu: "
        "`apt install libosmesa6` (osmesa). `lfd doctor` shows what works.\n"
    )


@pytest.mark.skipif(find_library("EGL") is None, reason="EGL is not installed here")
def test_a_driver_that_does_not_start_says_why() -> None:
    text = gl_fails("MUJOCO_EGL_DEVICE_ID", "99")
    assert text.startswith("offscreen rendering by egl does not start: The MUJOCO_EGL_DEVICE_ID")
    assert "`apt install libegl1 libgl1` (egl) or `apt install libosmesa6` (osmesa)" in text


def test_rendering_can_be_turned_off() -> None:
    assert "unset MUJOCO_GL" in gl_fails("MUJOCO_GL", "off")


def tessellated_cube(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A cube from 0 to 1 with `cells` x `cells` squares a side; points of different sides are not shared."""
    u, v = np.meshgrid(np.arange(cells + 1), np.arange(cells + 1), indexing="ij")
    grid = np.stack([u.ravel(), v.ravel()], 1) / cells
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right, up, both = corner + cells + 1, corner + 1, corner + cells + 2
    side = np.concatenate([np.stack([corner, right, both], 1), np.stack([corner, both, up], 1)])
    points, faces = [], []
    for axis in range(3):
        for place in (0.0, 1.0):
            faces.append((side if place else side[:, ::-1]) + sum(map(len, points)))
            points.append(np.roll(np.insert(grid, 2, place, axis=1), axis + 1, axis=1))
    return np.concatenate(points), np.concatenate(faces)


def test_simplify_keeps_corners_edges_and_volume() -> None:
    points, faces = tessellated_cube(20)
    moved, fewer, kept = simplify(points, faces, 0.26)
    assert len(fewer) < len(faces) / 10
    assert len(kept) == len(fewer)
    for corner in np.indices((2, 2, 2)).reshape(3, -1).T:
        assert np.linalg.norm(moved - corner, axis=1).min() < 0.02
    a, b, c = moved[fewer].transpose(1, 0, 2)
    assert np.einsum("fi,fi->", a, np.cross(b, c)) / 6 == pytest.approx(1, abs=0.02)  # closed, outside out


def test_simplify_minimises_distances_to_planes(rng) -> None:
    """The stated objective with its regularisation, by finite differences, for one cell."""
    points, faces = rng.uniform(0.1, 0.9, (12, 3)), rng.permutation(12).reshape(4, 3)
    moved, fewer, _ = simplify(points, faces, 1.0)
    assert len(moved) == 1
    assert len(fewer) == 0
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(normal, axis=1)
    normal /= double[:, None]

    def objective(x: np.ndarray) -> float:
        away = ((normal * (x - corners[:, 0])).sum(1) ** 2 * double).sum()
        return float(away + 0.01 * double.sum() * ((x - points.mean(0)) ** 2).sum())

    gradient = [(objective(moved[0] + step) - objective(moved[0] - step)) / 2e-5 for step in 1e-5 * np.eye(3)]
    inside = np.abs(moved[0] - points.mean(0)).max() < 0.5
    assert inside
    assert gradient == pytest.approx([0, 0, 0], abs=1e-8)


def test_any_thread_may_draw(start) -> None:
    """As the threads of parallel worlds do."""
    from concurrent.futures import ThreadPoolExecutor

    cameras = Cameras(start.model_xml, ["agentview"], height=32, width=32)
    here = cameras.render(start.sim)["agentview"]
    with ThreadPoolExecutor(3) as pool:
        for there in [pool.submit(cameras.render, start.sim).result() for _ in range(6)]:
            np.testing.assert_array_equal(there["agentview"], here)
    cameras.close()
