"""Pictures of a simulated world.

::

    scene = Scene(world, drones=2)               # once
    renderer = PlanarRenderer(scene)             # one a thread
    effects = SensorEffects(FRONT_CAMERA, seed)  # one a camera of each drone
    state = SceneState(positions, rotations, targets)
    pose = FRONT_CAMERA.pose(positions[0], rotations[0], drone=0)
    picture = effects.apply(renderer.render(state, pose, FRONT_CAMERA), number)
"""

from skyloop.sim.render.base import Renderer, SceneState
from skyloop.sim.render.effects import SensorEffects
from skyloop.sim.render.planar import PlanarRenderer, Quality, use_one_core
from skyloop.sim.render.scene import Scene

__all__ = ["PlanarRenderer", "Quality", "Renderer", "Scene", "SceneState", "SensorEffects", "use_one_core"]
