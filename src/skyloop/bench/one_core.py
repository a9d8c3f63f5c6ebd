"""The process of ``skyloop bench codecs``. Nothing that starts threads may be imported before it has its one core."""

from __future__ import annotations

import os

from skyloop.bench.workers import Pipe


def codecs_on_one_core(pipe: Pipe, seconds: float) -> None:
    """Sends shares of the work done, and the results in the end."""
    if hasattr(os, "sched_setaffinity"):  # elsewhere the libraries' threads are counted too
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    from skyloop.bench.codecs import measure_here

    pipe.send(measure_here(seconds, pipe.send))
    pipe.recv()
