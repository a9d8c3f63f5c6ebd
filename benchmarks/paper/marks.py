"""The experiment's log entries, so that its recording alone can be evaluated."""

from __future__ import annotations

from typing import Final

from skyloop.messages import Vector

APPLICATION: Final = "paper.application"  #: the application's number, as in echoes of commands
#: Arrays, row by row: when the proxy published [ns, its clock], the delay until reception [ns], and the number.
FEEDBACK_HEARD: Final = "paper.delays.feedback"
VIDEO_HEARD: Final = "paper.delays.video"
#: An array: x, y, z of the planned position at that time [m], and the number of waypoints reached before.
TARGET: Final = "paper.target"
WAYPOINTS: Final = "waypoints"  #: name expected by the cockpit: rows of x, y, z

#: The round of waypoints, in world axes [m]: a square of 2 m that climbs and sinks by 0.4 m.
CORNERS: Final[tuple[Vector, ...]] = ((1.0, 1.0, 1.0), (-1.0, 1.0, 1.4), (-1.0, -1.0, 1.0), (1.0, -1.0, 1.4))
SPEED_M_S: Final = 0.5
HOLD_S: Final = 1.0
