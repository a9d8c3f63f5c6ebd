"""Real proxies and applications as processes, in a directory of sockets of their own."""

from tests.support.processes import proxy, sockets, start

__all__ = ["proxy", "sockets", "start"]
