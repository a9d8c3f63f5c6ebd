"""Makes a process that sleeps and wakes thousands of times a second be woken on time, as far as that is allowed."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
from typing import Final

LOW_PRIORITY: Final = 1  #: of those of the real-time scheduler: before all ordinary processes
NICENESS: Final = -10  #: where only that is allowed
SLACK_NS: Final = 1  #: by which the kernel may wake it late on purpose; 50 µs otherwise
_PR_SET_TIMERSLACK: Final = 29  # linux/prctl.h


def become_prompt() -> None:
    """Have this process, and what it starts, woken on time: surely as root, less so else. Never raises.

    Only Linux is told.
    """
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, SLACK_NS)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(LOW_PRIORITY))
    except OSError:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
