"""Proxies for the tests of motion capture."""

from tests.support.processes import proxy, sockets, start

__all__ = ["proxy", "sockets", "start"]
