"""The renderer against a ray caster with independent mathematics: it intersects every pixel's ray with every quad's
plane in world axes, tests the point against the quad's edges there, and takes the nearest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.sim.camera import FRONT_CAMERA, CameraModel, CameraPose
from skyloop.sim.render.planar import PlanarRenderer, Quality
from skyloop.sim.render.quads import Atlas, AtlasBuilder, QuadBuilder, Quads, SceneState, Texture
from skyloop.sim.render.scene import Posed
from skyloop.sim.render.shading import DepthBuffer, Grid, visible_quads

PLAIN = replace(FRONT_CAMERA.scaled(0.5), distortion=(0.0,) * 5)
BENT = FRONT_CAMERA.scaled(0.5)
NOTHING_MOVES = SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)))
HALF = np.array([3.0, 2.5, 1.4])
TEXELS = 256


def smooth_texture(seed: int) -> NDArray[np.uint8]:
    """Return slowly changing colours, so that a mip level or a filter hardly changes the colour of a place."""
    rng = np.random.default_rng(seed)
    small = rng.integers(30, 225, (4, 4, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(small, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


@dataclass
class Stage:
    """A room with tilted boxes and a triangle, drawn from quads alone; replaces a Scene."""

    quads: Quads
    atlas: Atlas
    images: list[NDArray[np.uint8]]

    def posed(self, state: SceneState) -> Posed:
        return Posed(self.quads, np.full(len(self.quads), -1, np.intp), ())


def build_stage() -> Stage:
    atlas = AtlasBuilder()
    images: list[NDArray[np.uint8]] = []

    def texture() -> Texture:
        images.append(smooth_texture(len(images)))
        return atlas.add(len(images), lambda: images[-1])

    x, y, z = HALF
    room = QuadBuilder()
    for corner, right, up in (
        ((-x, y, -z), (2 * x, 0, 0), (0, 0, 2 * z)),
        ((x, -y, -z), (-2 * x, 0, 0), (0, 0, 2 * z)),
        ((x, y, -z), (0, -2 * y, 0), (0, 0, 2 * z)),
        ((-x, -y, -z), (0, 2 * y, 0), (0, 0, 2 * z)),
        ((-x, -y, -z), (2 * x, 0, 0), (0, 2 * y, 0)),
        ((x, -y, z), (-2 * x, 0, 0), (0, 2 * y, 0)),
    ):
        room.rectangle(corner, right, up, texture(), lit=False)
    parts = room.build()
    rng = np.random.default_rng(5)
    for _ in range(4):
        box = QuadBuilder()
        side = rng.uniform(0.1, 0.5, 3)
        box.box(-side, side, texture())
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        parts = parts.joined(box.build().moved(rng.uniform(-0.6, 0.6, 3) * HALF, turn))
    start, along = np.array([0.5, -1.0, -0.5]), np.array([0.8, 0.4, 0.0])
    across = np.array([-0.1, 0.2, 0.9])
    across -= along * (across @ along) / (along @ along)
    triangle = QuadBuilder()
    tips = [start, start + along, start + along, start + across]
    triangle.polygon(tips, start, along, across, texture(), two_sided=True)
    parts = replace(parts.joined(triangle.build()), lit=np.zeros(len(parts) + 1, np.bool_))
    return Stage(parts, atlas.pack(), images)


def random_poses(count: int) -> list[CameraPose]:
    """Return poses anywhere in the room, every other one 3 cm to 30 cm from a wall and looking along it."""
    rng = np.random.default_rng(11)
    poses = []
    for k in range(count):
        position = rng.uniform(-0.95, 0.95, 3) * HALF
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        if k % 2:
            axis = rng.integers(3)
            position[axis] = rng.choice((-1, 1)) * (HALF[axis] - rng.uniform(0.03, 0.3))
            ahead = turn[:, 2].copy()
            ahead[axis] *= 0.05
            ahead /= np.linalg.norm(ahead)
            right = np.cross(turn[:, 1], ahead)
            right /= np.linalg.norm(right)
            turn = np.column_stack([right, np.cross(ahead, right), ahead])
        poses.append(CameraPose(position, turn))
    return poses


def cast(quads: Quads, pose: CameraPose, rays: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the quad that each ray (n, 3; optical axes, z = 1) meets first, -1 for none, and its z [m]."""
    world = rays @ pose.rotation.T
    nearest, hit = np.full(len(rays), np.inf), np.full(len(rays), -1, np.intp)
    for k, corners in enumerate(quads.corners):
        normal = quads.normals[k]
        toward = world @ normal
        if not quads.two_sided[k]:
            toward = np.where(toward < 0.0, toward, np.nan)
        z = ((corners[0] - pose.position_m) @ normal) / toward
        inside = np.flatnonzero((z > 0.0) & (z < nearest))
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            points = pose.position_m + z[inside, None] * world[inside]
            inside = inside[(points - a) @ np.cross(normal, b - a) >= -1e-9]
        nearest[inside], hit[inside] = z[inside], k
    return hit, nearest


def away_from_edges(hit: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return the pixels whose neighbours all show the same quad."""
    numbers = hit.astype(np.float32)
    around = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(numbers, around) == cv2.erode(numbers, around))


def pixel_rays(model: CameraModel) -> NDArray[np.float64]:
    """Return rays from a table of the lens's effect on the radius, shape (pixels, 3)."""
    x, y = np.meshgrid(np.arange(model.width) - model.cx, np.arange(model.height) - model.cy)
    bent = np.column_stack([x.ravel() / model.fx, y.ravel() / model.fy])
    straight = np.linspace(0.0, 1.2, 200_001)
    k1, k2 = model.distortion[:2]
    radius = np.hypot(*bent.T)
    share = np.interp(radius, straight * (1 + k1 * straight**2 + k2 * straight**4), straight) / radius
    return np.column_stack([bent * share[:, None], np.ones(len(bent))])


@pytest.fixture(scope="module")
def stage() -> Stage:
    return build_stage()


@pytest.mark.slow
def test_no_quad_is_lost_and_depth_is_true_at_200_poses(stage: Stage) -> None:
    """Coverage: apart from pixels on an edge, each sample shows exactly the quad found by the ray caster, and none is
    empty. Depth: within 1e-9 of the distance."""
    grid = Grid(PLAIN.width, PLAIN.height, PLAIN.fx, PLAIN.fy, PLAIN.cx, PLAIN.cy)
    buffer = DepthBuffer(grid)
    rays = pixel_rays(PLAIN)
    for number, pose in enumerate(random_poses(200)):
        view = visible_quads(stage.quads, np.ones(len(stage.quads), np.bool_), pose, grid)
        buffer.draw(view, stage.quads.priority[view.index])
        assert buffer.seen.min() > 0, f"pose {number}: a hole in a closed room"
        hit, depth = cast(stage.quads, pose, rays)
        drawn = view.index[buffer.seen.ravel() - 1]
        inner = away_from_edges(hit.reshape(PLAIN.height, PLAIN.width)).ravel()
        assert (drawn == hit)[inner].all(), f"pose {number}"
        assert (drawn == hit).mean() > 0.999, f"pose {number}"
        same = drawn == hit
        inverse = np.einsum("ij,ij->i", view.inverse_depth[buffer.seen.ravel() - 1], rays)
        assert np.abs(inverse * depth - 1.0)[same].max() < 1e-9, f"pose {number}"


@pytest.mark.slow
@pytest.mark.parametrize("model", [PLAIN, BENT], ids=["pinhole", "barrel"])
@pytest.mark.parametrize("quality", list(Quality))
def test_colours_agree_away_from_edges(stage: Stage, model: CameraModel, quality: Quality) -> None:
    """Within 3 of 255 on average over a picture and 16 for 99.9 % of its pixels; neighbouring texels differ by up to
    3."""
    renderer = PlanarRenderer(stage, quality)  # type: ignore[arg-type]
    rays = pixel_rays(model)
    worst, means = [], []
    for pose in random_poses(24):
        hit, depth = cast(stage.quads, pose, rays)
        points = pose.position_m + depth[:, None] * (rays @ pose.rotation.T)
        u = np.einsum("ij,ij->i", stage.quads.u_slope[hit], points) + stage.quads.u_start[hit]
        v = np.einsum("ij,ij->i", stage.quads.v_slope[hit], points) + stage.quads.v_start[hit]
        columns, rows = np.clip(u, 0, TEXELS - 1).astype(int), np.clip(v, 0, TEXELS - 1).astype(int)
        expected = np.array(stage.images)[stage.quads.texture[hit], rows, columns].astype(int)
        picture = renderer.render(NOTHING_MOVES, pose, model).reshape(-1, 3).astype(int)
        inner = away_from_edges(hit.reshape(model.height, model.width)).ravel()
        error = np.abs(picture - expected)[inner]
        worst.append(np.quantile(error, 0.999))
        means.append(error.mean())
    assert max(worst) <= 16
    assert max(means) <= 3
