"""Use drones and swarms with ``asyncio``: methods that wait are coroutines, others are plain functions.

::

    async with skyloop.aio.connect("sim://") as drone:
        await drone.takeoff()
        async for frame in drone.frames():
            drone.velocity(forward=0.3)

The classes wrap :class:`skyloop.Drone` and :class:`skyloop.Swarm`, which run in their own threads and are available as
:attr:`Drone.sync` and :attr:`Swarm.sync`. Cancelling a call stops the wait, but does not undo the pending request.
"""

from skyloop.aio.bridge import Callback, Config, Drone, Listener, Swarm, connect, swarm

__all__ = ["Callback", "Config", "Drone", "Listener", "Swarm", "connect", "swarm"]
