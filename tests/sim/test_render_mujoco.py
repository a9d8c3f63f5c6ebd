"""The renderer that needs OpenGL, against the planar one and against exact geometry."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
from skyloop.errors import SkyloopError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA, CameraModel, CameraPose
from skyloop.sim.render import PlanarRenderer, Scene, SceneState
from skyloop.sim.world import FacePose, Marker, TargetState
from skyloop.sim.world_file import load_world
from tests.sim.test_render import BOARD, PLAIN, SLAB, WORLD, card_corners, detect, state_at

FAR_OFF = [(-2.0, 2.4, 0.1), (-2.0, -2.4, 0.1)]
#: As the board's, so that one detector finds all; flat on the floor, where the bottom camera sees it.
FLOOR = Marker("floor", FacePose((0.4, 0.2, 0.0), elevation_rad=np.pi / 2), replace(BOARD.pattern, marker_id=11))
STAGE = replace(WORLD, markers=(*WORLD.markers, FLOOR))


def missing() -> str:
    """Why there is nothing to test here."""
    try:
        from skyloop.sim.render.mujoco import require_opengl

        require_opengl()
    except SkyloopError as error:
        return str(error)
    return ""


WHY_NOT = missing()
with_opengl = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "MuJoCo draws here")

if not WHY_NOT:
    from skyloop.sim.render.mujoco import MujocoRenderer, _open_context


@pytest.fixture(scope="module")
def planar() -> PlanarRenderer:
    return PlanarRenderer(Scene(STAGE, drones=2))


@pytest.fixture(scope="module")
def renderer() -> MujocoRenderer:
    return MujocoRenderer(STAGE, drones=2)


def poses_before(face: FacePose, count: int, near_m: float, far_m: float, seed: int) -> list[CameraPose]:
    """Cameras in front of a face, up to 40° to its sides, that look about at it, tilted every way."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        aside, above = rng.uniform(-0.6, 0.6, 2)
        direction = face.rotation() @ np.array([np.sin(aside), np.sin(above), np.cos(aside) * np.cos(above)])
        direction /= np.linalg.norm(direction)
        position = np.array(face.position_m) + rng.uniform(near_m, far_m) * direction
        ahead = -direction + rng.uniform(-0.12, 0.12, 3)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, face.rotation()[:, 1] + rng.uniform(-0.3, 0.3, 3))
        right /= np.linalg.norm(right)
        poses.append(CameraPose(position, np.column_stack([right, np.cross(ahead, right), ahead])))
    return poses


@with_opengl
@pytest.mark.parametrize(
    ("model", "face", "marker", "span"),
    [
        (PLAIN, STAGE.markers[0].pose, 3, (0.8, 2.2)),
        (FRONT_CAMERA, STAGE.markers[0].pose, 3, (0.8, 2.2)),
        (FRONT_CAMERA.scaled(2.0), state_at(FAR_OFF).targets[0].face(BOARD), 7, (0.8, 2.0)),
        (BOTTOM_CAMERA, FLOOR.pose, 11, (0.8, 1.8)),
    ],
    ids=["pinhole", "barrel", "barrel, twice as fine, a moving board", "bottom camera, the floor"],
)
def test_marker_corners_are_where_geometry_and_the_planar_renderer_have_them(
    renderer: MujocoRenderer,
    planar: PlanarRenderer,
    model: CameraModel,
    face: FacePose,
    marker: int,
    span: tuple[float, float],
) -> None:
    state = state_at(FAR_OFF, board=(0.0, 2.5, 1.2), board_yaw=-np.pi / 2)
    if marker == 7:
        face = state.targets[0].face(BOARD)
    off: list[NDArray[np.float64]] = []
    apart: list[NDArray[np.float64]] = []
    for pose in poses_before(face, 12, *span, seed=marker):
        corners = (card_corners(face, 0.3) - pose.position_m) @ pose.rotation
        expected = model.project(corners)
        found = detect(renderer.render(state, pose, model)).get(marker)
        also = detect(planar.render(state, pose, model)).get(marker)
        if found is not None and also is not None:
            off.append(found - expected)
            apart.append(found - also)
    assert len(off) >= 10
    errors = np.linalg.norm(np.concatenate(off), axis=1)
    assert np.median(errors) < 0.35  # the detector's own, for the most part: 0.25 with the planar renderer
    assert errors.max() < 1.0
    assert np.abs(np.concatenate(off).mean(axis=0)).max() < 0.1  # no bias
    assert np.median(np.linalg.norm(np.concatenate(apart), axis=1)) < 0.3


def random_poses(count: int) -> list[CameraPose]:
    """Anywhere in the room but for its edges, looking anywhere."""
    rng = np.random.default_rng(3)
    poses = []
    for _ in range(count):
        position = rng.uniform(-1.0, 1.0, 3) * (3.6, 2.6, 1.2) + (0.0, 0.0, 1.5)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        poses.append(CameraPose(position, turn * np.sign(np.linalg.det(turn))))
    return poses


@with_opengl
@pytest.mark.parametrize("model", [PLAIN, FRONT_CAMERA], ids=["pinhole", "barrel"])
def test_everything_is_drawn_where_the_planar_renderer_draws_it(
    renderer: MujocoRenderer, planar: PlanarRenderer, model: CameraModel
) -> None:
    """Light and shadows differ, by less than 60 of 255; edges out of place and things left out would differ by more.
    The closed room leaves no pixel empty, which would be black."""
    state = state_at([(0.5, 0.4, 1.0), (-1.0, -0.6, 1.4)])
    for number, pose in enumerate(random_poses(30)):
        picture, other = renderer.render(state, pose, model), planar.render(state, pose, model)
        assert picture.max(axis=2).min() > 3, f"pose {number}: a hole"
        assert np.abs(picture.astype(int) - other).mean() < 20, f"pose {number}"
        soft, other_soft = (cv2.GaussianBlur(p, (0, 0), 1.0).astype(int) for p in (picture, other))
        assert (np.abs(soft - other_soft).max(axis=2) > 60).mean() < 0.005, f"pose {number}"


@with_opengl
def test_the_drone_with_the_camera_is_left_out_but_casts_its_shadow(renderer: MujocoRenderer) -> None:
    here = state_at([(-1.0, 0.0, 0.9), FAR_OFF[1]])
    away = state_at([(2.0, -2.4, 0.9), FAR_OFF[1]])
    pose = BOTTOM_CAMERA.pose(here.drone_positions_m[0], np.eye(3), 0)
    seen, without = renderer.render(here, pose, BOTTOM_CAMERA), renderer.render(away, pose, BOTTOM_CAMERA)
    light = seen.astype(float).sum(axis=2) / without.astype(float).sum(axis=2)
    middle = light[105:135, 145:175]
    assert 0.6 < middle.mean() < 0.85  # the shadow of its hull
    assert light[:20].mean() == pytest.approx(1.0, abs=0.02)
    # From its front camera there is nothing of it, however it tilts.
    for pitch in (-0.6, 0.0, 0.6):
        turn = np.array([rotation_from_euler(0.2, pitch, 0.5), np.eye(3)])
        tilted = replace(here, drone_rotations=turn)
        ahead = FRONT_CAMERA.pose(here.drone_positions_m[0], turn[0], 0)
        with_it = renderer.render(tilted, ahead, FRONT_CAMERA).astype(int)
        alone = renderer.render(replace(away, drone_rotations=turn), ahead, FRONT_CAMERA).astype(int)
        assert (alone - with_it).min() > -12, "only a shadow may differ"


@with_opengl
def test_other_drones_are_seen_and_cast_shadows(renderer: MujocoRenderer) -> None:
    away, here = state_at(FAR_OFF), state_at([FAR_OFF[0], (0.0, 0.0, 1.2)])
    pose = PLAIN.pose(np.array([-1.5, 0.0, 1.2]), rotation_from_euler(0.0, 0.35, 0.0), 0)
    before, after = renderer.render(away, pose, PLAIN).astype(int), renderer.render(here, pose, PLAIN).astype(int)

    def around(point: tuple[float, float, float]) -> tuple[slice, slice]:
        x, y = PLAIN.project((np.array([point]) - pose.position_m) @ pose.rotation)[0].round().astype(int)
        return slice(y - 4, y + 5), slice(x - 4, x + 5)

    body, shadow = around((0.0, 0.0, 1.2)), around((0.0, 0.0, 0.0))
    assert np.abs(after[body] - before[body]).mean() > 30
    share = after[shadow].sum() / before[shadow].sum()
    assert 0.6 < share < 0.85
    elsewhere = around((0.3, 1.0, 0.0))
    assert np.abs(after[elsewhere] - before[elsewhere]).mean() < 2


@with_opengl
def test_the_platform_shows_its_marker_where_it_is(renderer: MujocoRenderer) -> None:
    state = state_at(FAR_OFF, slab=(0.2, -0.9, 0.5), slab_yaw=0.7)
    pose = BOTTOM_CAMERA.pose(np.array([0.1, -0.8, 2.0]), np.eye(3))
    found = detect(renderer.render(state, pose, BOTTOM_CAMERA), "DICT_5X5_100")[42]
    corners = card_corners(state.targets[1].face(SLAB), 0.4)
    expected = BOTTOM_CAMERA.project((corners - pose.position_m) @ pose.rotation)
    assert found == pytest.approx(expected, abs=0.7)


@with_opengl
def test_the_same_picture_again_whatever_was_drawn_between(renderer: MujocoRenderer) -> None:
    state = state_at([(0.0, 0.0, 1.0), (1.0, 1.0, 1.0)])
    pose = FRONT_CAMERA.pose(state.drone_positions_m[0], np.eye(3), 0)
    out = np.empty((240, 320, 3), np.uint8)
    assert renderer.render(state, pose, FRONT_CAMERA, out) is out
    renderer.render(state_at(FAR_OFF), random_poses(1)[0], BOTTOM_CAMERA)
    renderer.close()
    assert np.array_equal(renderer.render(state, pose, FRONT_CAMERA), out)


@with_opengl
def test_what_does_not_fit_is_refused(renderer: MujocoRenderer) -> None:
    pose = random_poses(1)[0]
    with pytest.raises(UsageError, match="out is uint8 of shape"):
        renderer.render(state_at(FAR_OFF), pose, PLAIN, np.empty((3, 3, 3), np.uint8))
    with pytest.raises(UsageError, match="the scene has 2 drones"):
        renderer.render(state_at(FAR_OFF[:1]), pose, PLAIN)
    with pytest.raises(UsageError, match="the world has 2 moving targets, the state 0"):
        renderer.render(replace(state_at(FAR_OFF), targets=()), pose, PLAIN)


@with_opengl
@pytest.mark.parametrize("name", ["gates", "windy"])
def test_worlds_that_are_large_or_open_are_drawn_whole(name: str) -> None:
    world = load_world(name)
    targets = tuple(TargetState(t.name, 0.0, (1.0, 1.0, 1.0), 0.0, (0.0, 0.0, 0.0)) for t in world.targets)
    state = SceneState(np.array([[0.0, 0.0, 1.0]]), np.eye(3)[None], targets)
    pose = FRONT_CAMERA.pose(np.array([0.0, 0.0, 1.5]), rotation_from_euler(0.1, -0.2, 0.8))
    picture = MujocoRenderer(world, 1).render(state, pose, FRONT_CAMERA)
    other = PlanarRenderer(Scene(world, 1)).render(state, pose, FRONT_CAMERA)
    assert picture.max(axis=2).min() > 3
    assert np.abs(picture.astype(int) - other).mean() < 20


@with_opengl
def test_a_simulated_drone_gives_its_pictures() -> None:
    driver = make_driver("sim://?renderer=mujoco&noise=0")
    sink = RecordingSink()
    driver.open(sink)
    try:
        assert sink.wait(lambda: sink.frame_counts["front"] >= 2 and sink.frame_counts["bottom"] >= 2, 20.0)
    finally:
        driver.close()
    assert not sink.problems, sink.problems[:3]
    assert sink.frames[-1].pixels.std() > 5


@with_opengl
def test_opengl_that_fails_is_told_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import mujoco

    def fails(*_: object) -> None:
        raise mujoco.FatalError("an OpenGL platform library has not been loaded")

    monkeypatch.setattr(mujoco, "Renderer", fails)
    with pytest.raises(UnsupportedError, match="apt-get install libegl1 libgl1-mesa-dri"):
        _open_context(mujoco.MjSpec().compile(), 16, 16)
    with pytest.raises(UnsupportedError, match="libosmesa6"):
        make_driver("sim://?renderer=mujoco").open(RecordingSink())


def test_an_unknown_renderer_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="no renderer named 'mujoko'; did you mean 'mujoco'"):
        make_driver("sim://?renderer=mujoko")


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (
            "sys.modules['mujoco'] = None; os.environ['MUJOCO_GL'] = 'egl'",
            "MissingExtraError",
            "install mujoco",
        ),
        ("os.environ.pop('MUJOCO_GL', 0); ctypes.util.find_library = lambda _: None", "UnsupportedError", "libegl1"),
    ],
    ids=["no mujoco", "no OpenGL"],
)
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere OpenGL comes with the system")
def test_where_it_is_not_installed_it_says_what_to_install(given: str, error: str, words: str) -> None:
    """In a process of its own: what is imported stays imported."""
    script = f"""
import ctypes.util, os, sys
import skyloop.sim.render
{given}
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.registry import make_driver
try:
    make_driver("sim://?renderer=mujoco").open(RecordingSink())
except Exception as raised:
    print(type(raised).__name__, raised)
"""
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True).stdout
    assert said.startswith(error)
    assert words in said
