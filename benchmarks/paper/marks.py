"""What the experiment's application logs, so that its recording alone holds all that is needed to evaluate it."""

from __future__ import annotations

from typing import Final

from skyloop.messages import Vector

APPLICATION: Final = "paper.application"  #: a number: which of the applications it is, as echoes of commands name them
#: Arrays, row by row: when the proxy published it [ns, its clock], how much later it was received [ns], and its number.
FEEDBACK_HEARD: Final = "paper.delays.feedback"
VIDEO_HEARD: Final = "paper.delays.video"
#: An array: x, y, z of where it should be at that time [m], and how many waypoints were reached before.
TARGET: Final = "paper.target"
WAYPOINTS: Final = "waypoints"  #: under which the cockpit expects them: a row each of x, y, z

#: The round of waypoints, in world axes [m]: a square of 2 m that climbs and sinks by 0.4 m.
CORNERS: Final[tuple[Vector, ...]] = ((1.0, 1.0, 1.0), (-1.0, 1.0, 1.4), (-1.0, -1.0, 1.0), (1.0, -1.0, 1.4))
SPEED_M_S: Final = 0.5
HOLD_S: Final = 1.0
