"""Rendering of a simulated world."""

from skyloop.sim.render.base import Renderer, SceneState
from skyloop.sim.render.effects import SensorEffects
from skyloop.sim.render.planar import PlanarRenderer, Quality, use_one_core
from skyloop.sim.render.scene import Scene

__all__ = ["PlanarRenderer", "Quality", "Renderer", "Scene", "SceneState", "SensorEffects", "use_one_core"]
