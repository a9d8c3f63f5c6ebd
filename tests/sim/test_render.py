"""The content of a world's pictures. Agreement with exact geometry is tested in ``test_render_agreement``."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA, CameraModel, CameraPose
from skyloop.sim.render import PlanarRenderer, Quality, Scene, SceneState
from skyloop.sim.render.planar import prepare
from skyloop.sim.world import (
    FacePose,
    Marker,
    MarkerPattern,
    Room,
    TargetState,
    World,
)
from skyloop.sim.world_file import load_world, shipped_worlds
from tests.sim.furnished_room import WORLD, state_at

PLAIN = replace(FRONT_CAMERA, distortion=(0.0,) * 5, position_m=(0.0, 0.0, 0.0))
SIDE = 5


def detect(picture: NDArray[np.uint8], name: str = "DICT_4X4_50") -> dict[int, NDArray[np.float64]]:
    """Return marker ids and their corners (4, 2): top left, top right, bottom right, bottom left."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(picture)
    return {} if ids is None else {int(i): c[0].astype(float) for i, c in zip(ids.ravel(), corners, strict=True)}


def card_corners(face: FacePose, size_m: float) -> NDArray[np.float64]:
    """Return world positions of a marker's corners in the detector's order, shape (4, 3)."""
    offsets = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]) * size_m / 2
    return np.array(face.position_m) + offsets @ face.rotation()[:, :2].T


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(WORLD, drones=2)


def view_from(
    scene: Scene,
    state: SceneState,
    position: tuple[float, float, float],
    euler: tuple[float, float, float] = (0.0, 0.0, 0.0),
    model: CameraModel = PLAIN,
    drone: int | None = None,
    quality: Quality = Quality.SMOOTH,
) -> NDArray[np.uint8]:
    pose = model.pose(np.array(position), rotation_from_euler(*euler), drone)
    return PlanarRenderer(scene, quality).render(state, pose, model)


@pytest.mark.parametrize("quality", list(Quality))
@pytest.mark.parametrize("model", [FRONT_CAMERA, BOTTOM_CAMERA, PLAIN.scaled(2.0)], ids=lambda m: f"{m.name}{m.width}")
def test_a_picture_is_the_same_bit_by_bit_after_any_other(scene: Scene, model: CameraModel, quality: Quality) -> None:
    state = state_at([(-2.0, 0.0, 1.0), (0.0, 0.5, 1.1)])
    pose = model.pose(state.drone_positions_m[0], state.drone_rotations[0], 0)
    used = PlanarRenderer(scene, quality)
    used.render(state_at([(1.0, 1.0, 2.0), (0.0, 0.0, 0.1)]), elsewhere(pose), model)
    out = np.empty((model.height, model.width, 3), np.uint8)
    assert used.render(state, pose, model, out) is out
    again = PlanarRenderer(Scene(WORLD, drones=2), quality).render(state, pose, model)
    assert np.array_equal(out, again)


def elsewhere(pose: CameraPose) -> CameraPose:
    """Return the same camera at another position."""
    return replace(pose, position_m=pose.position_m + np.array([0.3, -0.2, 0.1]))


def test_board_and_platform_show_their_markers_in_the_right_places(scene: Scene) -> None:
    state = state_at(
        [(-3.0, 0.0, 1.2)] * 2, board=(0.0, 0.3, 1.3), board_yaw=np.pi + 0.3, slab=(0.2, -0.9, 0.5), slab_yaw=0.7
    )
    board, slab = (s.face(t) for s, t in zip(state.targets, WORLD.targets, strict=True))
    pose = PLAIN.pose(np.array([-1.5, 0.0, 1.2]), np.eye(3))
    found = detect(view_from(scene, state, (-1.5, 0.0, 1.2)))[7]
    expected = PLAIN.project((card_corners(board, 0.3) - pose.position_m) @ pose.rotation)
    assert found == pytest.approx(expected, abs=0.7)

    above = BOTTOM_CAMERA.pose(np.array([0.1, -0.8, 2.0]), np.eye(3))
    found = detect(view_from(scene, state, (0.1, -0.8, 2.0), model=BOTTOM_CAMERA), "DICT_5X5_100")[42]
    expected = BOTTOM_CAMERA.project((card_corners(slab, 0.4) - above.position_m) @ above.rotation)
    assert found == pytest.approx(expected, abs=0.7)


def ideal_marker_view(
    face: FacePose, marker_id: int, size_m: float, card_m: float, pose: CameraPose, model: CameraModel
) -> NDArray[np.uint8]:
    """Return an ideal camera's view of a marker in front of a grey wall: SIDE by SIDE exact samples per pixel."""
    offsets = (np.arange(SIDE) + 0.5) / SIDE - 0.5
    x = ((np.arange(model.width)[:, None] + offsets).ravel() - model.cx) / model.fx
    y = ((np.arange(model.height)[:, None] + offsets).ravel() - model.cy) / model.fy
    turn = face.rotation()
    plane = pose.rotation.T @ np.column_stack([turn[:, :2], np.array(face.position_m) - pose.position_m])
    u, v, w = (row[0] * x[None, :] + row[1] * y[:, None] + row[2] for row in np.linalg.inv(plane))
    u, v = u / w, v / w
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    cells = cv2.aruco.generateImageMarker(dictionary, marker_id, 6, borderBits=1) > 127
    column, row = (np.floor((c / size_m + 0.5) * 6).astype(int) for c in (u, -v))
    black = (np.clip(column, 0, 5) == column) & (np.clip(row, 0, 5) == row)
    ink = np.where(cells[np.clip(row, 0, 5), np.clip(column, 0, 5)], 235.0, 22.0)
    card = np.maximum(np.abs(u), np.abs(v)) < card_m / 2
    samples = np.where(black, ink, np.where(card, 235.0, 190.0))
    picture = samples.reshape(model.height, SIDE, model.width, SIDE).mean(axis=(1, 3))
    return np.asarray(np.rint(picture), dtype=np.uint8)


def test_marker_corners_are_true_to_a_third_of_a_pixel_and_unbiased() -> None:
    """Relative to the detector's result in an ideal picture: its own error, 0.2 px here, is not the renderer's."""
    pattern = MarkerPattern("DICT_4X4_50", 3, 0.3, 0.05)
    face = FacePose((3.99, 0.0, 1.5), yaw_rad=np.pi)
    scene = Scene(World("wall", Room((8.0, 12.0, 3.0)), markers=(Marker("m", face, pattern),)), drones=0)
    state = SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)))
    renderer = PlanarRenderer(scene)
    rng = np.random.default_rng(0)
    apart, off, radial = [], [], []
    for distance in (0.8, 1.2, 1.6, 2.0):
        for _ in range(6):
            bearing = rng.uniform(-0.9, 0.9)
            place = np.array(face.position_m) + distance * np.array(
                [-np.cos(bearing), np.sin(bearing), rng.uniform(-0.2, 0.2)]
            )
            yaw = np.arctan2(-place[1], face.position_m[0] - place[0]) + rng.uniform(-0.1, 0.1)
            pose = PLAIN.pose(place, rotation_from_euler(rng.uniform(-0.2, 0.2), rng.uniform(-0.05, 0.05), yaw))
            exact = PLAIN.project((card_corners(face, 0.3) - pose.position_m) @ pose.rotation)
            drawn = detect(renderer.render(state, pose, PLAIN)).get(3)
            ideal = detect(ideal_marker_view(face, 3, 0.3, 0.4, pose, PLAIN)).get(3)
            if drawn is None or ideal is None:
                continue
            apart.append(np.hypot(*(drawn - ideal).T))
            off.append(drawn - exact)
            outward = exact - exact.mean(axis=0)
            outward /= np.linalg.norm(outward, axis=1, keepdims=True)
            radial.append(((drawn - ideal) * outward).sum(axis=1))
    assert len(apart) >= 21  # of 24: the detector sometimes misses a marker, also in ideal pictures
    assert np.median(apart) < 0.2
    assert np.median(np.hypot(*np.concatenate(off).T)) < 0.3
    assert np.abs(np.mean(np.concatenate(off), axis=0)).max() < 0.06
    assert abs(np.mean(radial)) < 0.06


@pytest.mark.parametrize("name", shipped_worlds())
def test_every_shipped_world_is_drawn_completely_and_with_detail(name: str) -> None:
    world = load_world(name)
    scene = Scene(world, drones=1)
    targets = tuple(TargetState(t.name, 0.0, (0.5, 0.5, 1.0), 0.0, (0.0, 0.0, 0.0)) for t in world.targets)
    state = SceneState(np.array([[0.0, 0.0, 1.0]]), np.eye(3)[None], targets)
    renderer = PlanarRenderer(scene)
    rng = np.random.default_rng(3)
    for _ in range(6):
        place = rng.uniform(-0.4, 0.4, 3) * world.room.size_m + (0.0, 0.0, world.room.size_m[2] / 2)
        turn = rotation_from_euler(*rng.uniform((-0.5, -0.5, -3.1), (0.5, 0.5, 3.1)))
        picture = renderer.render(state, FRONT_CAMERA.pose(place, turn, 0), FRONT_CAMERA)
        assert (picture.max(axis=2) > 0).all(), "a pixel that shows nothing"
        assert picture.std() > 4.0


@pytest.mark.parametrize("length_m", [20.0, 300.0, 400.0])
def test_open_ground_has_a_sky(length_m: float) -> None:
    scene = Scene(World("field", Room((length_m, 20.0, 10.0), floor="grass", enclosed=False)), drones=0)
    state = SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)))
    picture = view_from(scene, state, (0.0, 0.0, 2.0), model=FRONT_CAMERA)
    blue, green, red = picture[20].mean(axis=0)
    assert blue > green > red
    blue, green, red = picture[-20].mean(axis=0)
    assert green > blue
    assert (picture.max(axis=2) > 0).all()


def test_a_drone_sees_others_but_not_itself(scene: Scene) -> None:
    here, there = (-2.0, 0.0, 1.0), (-0.8, 0.1, 1.1)
    both = view_from(scene, state_at([here, there]), here, drone=0)
    alone = view_from(scene, state_at([here, (-3.9, 0.0, 2.9)]), here, drone=0)
    changed = np.asarray(both != alone).any(axis=2)
    rows, columns = np.nonzero(np.atleast_2d(changed)[:140])
    expected = PLAIN.project((np.array([there]) - here) @ PLAIN.rotation_matrix)[0]
    assert columns.mean() == pytest.approx(expected[0], abs=6)
    assert rows.mean() == pytest.approx(expected[1], abs=6)
    outside = view_from(scene, state_at([here, (-3.9, 0.0, 2.9)]), (-2.3, 0.0, 1.0), drone=1)
    assert (
        np.abs(outside.astype(int) - view_from(scene, state_at([there, there]), (-2.3, 0.0, 1.0), drone=1)).max() > 60
    )


def test_a_flying_drone_darkens_the_floor_or_crate_below_it(scene: Scene) -> None:
    down = (0.0, np.pi / 2, 0.0)
    far = (-3.5, -2.6, 2.9)
    bright = view_from(scene, state_at([far, far]), (-1.0, 0.0, 2.5), down)
    dark = view_from(scene, state_at([(-1.0, 0.0, 0.6), far]), (-1.0, 0.0, 2.5), down, drone=0)
    assert dark[110:130, 150:170].mean() < 0.8 * bright[110:130, 150:170].mean()
    assert np.array_equal(dark[:10], bright[:10])
    on_crate = view_from(scene, state_at([(2.0, 1.5, 1.1), far]), (2.0, 1.5, 2.0), down, drone=0)
    crate = view_from(scene, state_at([far, far]), (2.0, 1.5, 2.0), down, drone=0)
    assert on_crate[110:130, 150:170].mean() < 0.8 * crate[110:130, 150:170].mean()


def test_mismatched_arguments_are_refused(scene: Scene) -> None:
    state = state_at([(0.0, 0.0, 1.0)] * 2)
    pose = PLAIN.pose(np.zeros(3), np.eye(3))
    renderer = PlanarRenderer(scene)
    with pytest.raises(UsageError, match="out has"):
        renderer.render(state, pose, PLAIN, np.empty((10, 10, 3), np.uint8))
    with pytest.raises(UsageError, match="2 drones"):
        renderer.render(state_at([(0.0, 0.0, 1.0)]), pose, PLAIN)
    with pytest.raises(UsageError, match="moving targets"):
        renderer.render(replace(state, targets=()), pose, PLAIN)
    with pytest.raises(UsageError, match="no inverse"):
        renderer.render(state, pose, replace(PLAIN, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("pattern", "error"),
    [
        (MarkerPattern("DICT_4X4_5", 0, 0.2, 0.0), UnknownNameError),
        (MarkerPattern("DICT_4X4_50", 50, 0.2, 0.0), UsageError),
    ],
)
def test_markers_that_do_not_exist_are_refused(pattern: MarkerPattern, error: type[Exception]) -> None:
    world = World("w", Room((4.0, 4.0, 3.0)), markers=(Marker("m", FacePose((0.0, 0.0, 0.0)), pattern),))
    with pytest.raises(error, match="DICT_4X4_50"):
        Scene(world)


def test_without_opencv_the_error_names_the_package() -> None:
    code = (
        "import sys; sys.modules['cv2'] = None\n"
        "from skyloop.errors import MissingExtraError\n"
        "try:\n    import skyloop.sim.render\n"
        "except MissingExtraError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert "skyloop install sim" in done.stdout


@pytest.mark.parametrize("quality", list(Quality))
def test_a_prepared_lens_is_computed_once_for_all_renderers(
    scene: Scene, quality: Quality, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = replace(FRONT_CAMERA, width=40, height=30, fx=26.0 + list(Quality).index(quality))
    prepare(model, quality)
    monkeypatch.setattr("skyloop.sim.render.painter._rays", lambda *_: pytest.fail("computed again"))
    for _ in range(2):
        view_from(scene, state_at([(0.0, 0.0, 1.0), (2.0, 0.0, 1.0)]), (-1.0, 0.0, 1.0), model=model, quality=quality)
