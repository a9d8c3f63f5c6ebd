"""Runs a flight firmware as its only child, and ends it when whoever started this process ends.

``python -m skyloop.vehicles.sim.firmware.keeper FOLDER LOG [--prompt] [--apart=…] NAME=VALUE … -- COMMAND …``: the
firmware's process id is written to standard output; what the firmware writes is appended to LOG. With ``--prompt`` it
is woken before others, with ``--apart`` it gets a network of its own (:mod:`skyloop.vehicles.sim.firmware.ports`).
Exits with the firmware's code, with 128 and the number of the signal that ended it, as a shell does.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from skyloop.child_process import on_parent_end
from skyloop.vehicles.sim.firmware import ports

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


def hasten(by: int) -> None:
    """Change the niceness of all threads of this process, and of those that they start, as far as the rights go.

    Only on Linux does each thread have one of its own.
    """
    if sys.platform == "linux":
        for thread in [int(task.name) for task in Path("/proc/self/task").iterdir()]:
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + by)


TERMINATE_S: Final = 2.0  #: for the firmware to end by itself
PROMPT: Final = "--prompt"
_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h


def main(arguments: list[str]) -> int:
    """Run the firmware until it ends or standard input does; return the exit code."""
    cut = arguments.index("--")
    folder, log, *settings = arguments[:cut]
    prompt = PROMPT in settings
    if prompt:
        settings.remove(PROMPT)
    relays = [ports.Relay(setting) for setting in settings if setting.startswith(ports.OPTION)]
    settings = [setting for setting in settings if not setting.startswith(ports.OPTION)]
    environment = {**os.environ, **dict(setting.split("=", 1) for setting in settings)}
    libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None

    def begin() -> None:
        if libc is not None:  # this process may be killed, and then tells nobody
            libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if prompt:
            become_prompt()

    with Path(log).open("ab") as output:
        firmware = subprocess.Popen(
            arguments[cut + 1 :],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=begin,  # noqa: PLW1509  there is one thread yet
        )
    print(firmware.pid, flush=True)
    for relay in relays:
        relay.start()

    def end() -> None:
        firmware.terminate()
        firmware.send_signal(signal.SIGCONT)  # one that is stopped gets nothing else
        try:
            firmware.wait(TERMINATE_S)
        except subprocess.TimeoutExpired:
            firmware.kill()

    on_parent_end(end)
    code = firmware.wait()
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
