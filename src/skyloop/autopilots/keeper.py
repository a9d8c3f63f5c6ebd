"""Runs a flight firmware as its only child, and ends it when whoever started this process ends.

``python -m skyloop.autopilots.keeper FOLDER LOG NAME=VALUE … -- COMMAND …``: the firmware's process id is written to
standard output; what the firmware writes is appended to LOG. Exits with the firmware's code, with 128 and the number of
the signal that ended it, as a shell does.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

from skyloop.child_process import on_parent_end

TERMINATE_S: Final = 2.0  #: for the firmware to end by itself
_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h


def main(arguments: list[str]) -> int:
    """Run the firmware until it ends or standard input does; return the exit code."""
    cut = arguments.index("--")
    folder, log, *settings = arguments[:cut]
    environment = {**os.environ, **dict(setting.split("=", 1) for setting in settings)}
    libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None

    def end_with_parent() -> None:  # this process may be killed, and then tells nobody
        if libc is not None:
            libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    with Path(log).open("ab") as output:
        firmware = subprocess.Popen(
            arguments[cut + 1 :],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=end_with_parent,  # noqa: PLW1509  there is one thread yet
        )
    print(firmware.pid, flush=True)

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
