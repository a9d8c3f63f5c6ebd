"""Skyloop's own ends, as in ``skyloop bench``; see :mod:`benchmarks.measuring.contract`."""

from skyloop.bench import Application, Listening, Vehicle, proxy_name

__all__ = ["Application", "Listening", "Vehicle", "proxy_name"]
