"""Proxies for the tests of motion capture."""

from tests.integration.processes.conftest import proxy, sockets, start

__all__ = ["proxy", "sockets", "start"]
