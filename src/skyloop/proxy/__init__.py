"""The proxy for one vehicle: authority, command checks, failsafe ladder, limits, parameters, software autopilot.

``docs/proxy.md`` describes the rules. :class:`Proxy` runs in any process; the command line uses
:func:`skyloop.proxy.serve.serve`.
"""

from skyloop.proxy.proxy import Proxy

__all__ = ["Proxy"]
