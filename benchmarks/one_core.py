"""The process of ``benchmarks.codecs``. Nothing that starts threads may be imported before it has its one core."""

from __future__ import annotations

import os

from benchmarks.measuring.workers import Pipe


def codecs_on_one_core(pipe: Pipe, seconds: float) -> None:
    """Send the shares of the work that are done, and the results in the end."""
    if hasattr(os, "sched_setaffinity"):  # elsewhere the libraries' threads are counted too
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    from benchmarks.codecs import measure_here

    pipe.send(measure_here(seconds, pipe.send))
    pipe.recv()
