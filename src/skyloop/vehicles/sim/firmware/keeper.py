"""Run flight firmware as the only child process, and end it when the parent of this process ends.

``python -m skyloop.vehicles.sim.firmware.keeper FOLDER LOG [--real-time] [--network=…] NAME=VALUE … -- COMMAND …``
writes the firmware's process id to standard output and appends the firmware's output to LOG. ``--real-time`` gives the
firmware priority; ``--network`` gives it a separate network (:mod:`skyloop.vehicles.sim.firmware.ports`). The exit code
is the firmware's or, as in a shell, 128 plus the number of the signal that ended it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Final

from skyloop.child_process import on_parent_end
from skyloop.vehicles.sim.firmware import ports

LOW_PRIORITY: Final = 1  #: priority in the real-time scheduler, which runs ahead of all ordinary processes
NICENESS: Final = -10  #: niceness without real-time scheduling, and change of it by :func:`raise_priority`
SLACK_NS: Final = 1  #: how long the kernel may delay wake-ups; its default is 50 µs
_PR_SET_TIMERSLACK: Final = 29  # linux/prctl.h
TERMINATE_S: Final = 2.0  #: time allowed for the firmware to exit on request
REAL_TIME: Final = "--real-time"
_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h

_priority_lock: Final = threading.Lock()  # guards the two variables below, which are process-wide like the niceness
_prioritizers = 0  # number of raise_priority() calls that have not been undone
_niceness: Final[dict[int, int]] = {}  # original niceness of each thread whose niceness was changed


def request_real_time() -> None:
    """Have the kernel wake up this process and its children on time. Works only on Linux, reliably only as root."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, SLACK_NS)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(LOW_PRIORITY))
    except OSError:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, NICENESS)


def raise_priority() -> None:
    """Raise the priority of all threads of this process, and of the threads that they start, as far as permitted.

    Only Linux keeps a niceness for each thread. Calling :func:`restore_priority` equally often restores it.
    """
    global _prioritizers  # noqa: PLW0603
    if sys.platform != "linux":
        return
    with _priority_lock:
        _prioritizers += 1
        for thread in _threads() if _prioritizers == 1 else ():
            with suppress(OSError):
                niceness = os.getpriority(os.PRIO_PROCESS, thread)
                os.setpriority(os.PRIO_PROCESS, thread, niceness + NICENESS)
                _niceness[thread] = niceness


def restore_priority() -> None:
    """Restore the niceness from before :func:`raise_priority`; later threads get the highest saved value."""
    global _prioritizers  # noqa: PLW0603
    if sys.platform != "linux":
        return
    with _priority_lock:
        _prioritizers -= 1
        for thread in _threads() if _niceness and not _prioritizers else ():
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, thread, _niceness.get(thread, max(_niceness.values())))
        if not _prioritizers:
            _niceness.clear()


def _threads() -> list[int]:
    return [int(task.name) for task in Path("/proc/self/task").iterdir()]


def main(arguments: list[str]) -> int:
    """Run the firmware until it ends or standard input is closed; return the exit code."""
    if sys.platform == "win32":  # the firmware's programs are for Linux, and perhaps macOS
        raise NotImplementedError
    cut = arguments.index("--")
    folder, log, *settings = arguments[:cut]
    real_time = REAL_TIME in settings
    if real_time:
        settings.remove(REAL_TIME)
    relays = [ports.Relay(setting) for setting in settings if setting.startswith(ports.OPTION)]
    settings = [setting for setting in settings if not setting.startswith(ports.OPTION)]
    environment = {**os.environ, **dict(setting.split("=", 1) for setting in settings)}
    libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None

    def begin() -> None:
        if libc is not None:  # if this process is killed, it can't end the firmware
            libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if real_time:
            request_real_time()

    with Path(log).open("ab") as output:
        firmware = subprocess.Popen(
            arguments[cut + 1 :],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=begin,  # noqa: PLW1509  there is only one thread at this point
        )
    print(firmware.pid, flush=True)
    for relay in relays:
        relay.start()

    def end() -> None:
        firmware.terminate()
        firmware.send_signal(signal.SIGCONT)  # a stopped process receives no other signal
        try:
            firmware.wait(TERMINATE_S)
        except subprocess.TimeoutExpired:
            firmware.kill()

    on_parent_end(end)
    code = firmware.wait()
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
