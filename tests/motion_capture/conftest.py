"""Proxies for the tests of motion capture."""

from tests.processes.conftest import proxy, sockets, start

__all__ = ["proxy", "sockets", "start"]
