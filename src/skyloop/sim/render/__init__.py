"""Rendering of a simulated world."""

from skyloop.sim.render.planar import PlanarRenderer, Quality, SensorEffects, use_one_core
from skyloop.sim.render.quads import SceneState
from skyloop.sim.render.scene import Scene

__all__ = ["PlanarRenderer", "Quality", "Scene", "SceneState", "SensorEffects", "use_one_core"]
