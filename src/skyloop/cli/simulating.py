"""Settings of a process that only simulates."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from skyloop.sim.options import SimOptions

SWITCH_INTERVAL_S: Final = 0.001


def settle(options: SimOptions) -> None:
    """Make room, in this whole process, for the threads that pass commands on beside those that step and draw.

    The interpreter lock is handed over after a millisecond, not five, and OpenCV keeps to one core. Do not call it in
    the user's process.

    Raises:
        MissingExtraError: Cameras are wanted, and what draws them is not installed.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    if options.cameras:
        from skyloop.sim.render import use_one_core

        use_one_core()
