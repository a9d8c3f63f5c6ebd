"""Real proxies and applications as separate processes, in a private directory of sockets."""

from tests.support.processes import proxy, sockets, start

__all__ = ["proxy", "sockets", "start"]
