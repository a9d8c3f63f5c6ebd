"""A furnished room, and the positions of its drones and targets."""

from __future__ import annotations

import numpy as np

from skyloop.sim.render import SceneState
from skyloop.sim.world import (
    BoardTarget,
    Box,
    FacePose,
    FixedYaw,
    Gate,
    Marker,
    MarkerPattern,
    Panel,
    PlatformTarget,
    Room,
    TargetState,
    WaypointPath,
    World,
)

STILL = WaypointPath(((0.0, 0.0, 1.2), (0.1, 0.0, 1.2)), 0.1)
BOARD = BoardTarget("board", MarkerPattern("DICT_4X4_50", 7, 0.3, 0.05), STILL, FixedYaw(0.0))
SLAB = PlatformTarget("slab", MarkerPattern("DICT_5X5_100", 42, 0.4, 0.05), STILL, FixedYaw(0.0), (0.8, 0.8, 0.1))
WORLD = World(
    "test",
    Room((8.0, 6.0, 3.0)),
    boxes=(
        Box("crate", (2.0, 1.5, 0.4), (0.8, 0.8, 0.8)),
        Box("case", (2.5, -1.8, 0.9), (0.4, 1.2, 1.8), 0.2, "books"),
    ),
    gates=(Gate("gate", (1.0, -1.0, 1.2), (0.8, 0.8)),),
    panels=(Panel("chart", FacePose((4.0, 0.0, 1.6), yaw_rad=np.pi), (1.6, 1.0), "poster_chart"),),
    markers=(Marker("wall", FacePose((-4.0, 0.0, 1.5), yaw_rad=0.0), MarkerPattern("DICT_4X4_50", 3, 0.3, 0.05)),),
    targets=(BOARD, SLAB),
)


def state_at(
    drones: list[tuple[float, float, float]],
    board: tuple[float, float, float] = (0.0, 2.5, 1.2),
    slab: tuple[float, float, float] = (0.0, -2.3, 0.5),
    board_yaw: float = np.pi,
    slab_yaw: float = 0.0,
) -> SceneState:
    """Return the state of level drones facing east, and the two targets."""
    targets = (
        TargetState("board", 0.0, board, board_yaw, (0.0, 0.0, 0.0)),
        TargetState("slab", 0.0, slab, slab_yaw, (0.0, 0.0, 0.0)),
    )
    return SceneState(np.array(drones).reshape(-1, 3), np.tile(np.eye(3), (len(drones), 1, 1)), targets)
