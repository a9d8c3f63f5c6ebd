"""Work for the processes of the tests."""

from __future__ import annotations

from benchmarks.measuring.workers import Pipe


def fails(pipe: Pipe) -> None:
    raise RuntimeError("on purpose")


def is_silent(pipe: Pipe) -> None:
    pipe.recv()


def echo(pipe: Pipe, what: int | str) -> None:
    pipe.send(what)
    pipe.recv()
