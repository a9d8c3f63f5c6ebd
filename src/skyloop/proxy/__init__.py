"""The proxy: authority, command checks, failsafe ladder, limits, parameters and software autopilot of one vehicle.

The rules are in ``docs/proxy.md``. :class:`Proxy` runs in any process; :func:`skyloop.proxy.serve.serve` is what the
command line runs.
"""

from skyloop.proxy.proxy import Proxy

__all__ = ["Proxy"]
