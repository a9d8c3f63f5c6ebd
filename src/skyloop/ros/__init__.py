"""Drones as nodes of ROS 2: topics, services and parameters (extra ``[ros]``), listed in ``docs/ros.md``.

::

    from skyloop.ros import Bridge, Settings

    with Bridge(Settings(drones=("alpha",))) as bridge:
        bridge.run()
"""

from skyloop.ros.bridge import Bridge, Settings

__all__ = ["Bridge", "Settings"]
