"""The same directory of sockets and made-up results as for ``skyloop bench``."""

from tests.bench.conftest import made_up, sockets

__all__ = ["made_up", "sockets"]
