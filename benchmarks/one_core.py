"""The process of ``benchmarks.codecs``. Import nothing that starts threads before it is limited to one core."""

from __future__ import annotations

import os

from benchmarks.measuring.workers import Pipe


def codecs_on_one_core(pipe: Pipe, seconds: float) -> None:
    """Send the fraction of the work done, and finally the results."""
    if hasattr(os, "sched_setaffinity"):  # on other systems, the libraries' threads are counted too
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    from benchmarks.codecs import measure_here

    pipe.send(measure_here(seconds, pipe.send))
    pipe.recv()
