"""What proxies, the cockpit and routers count, for Prometheus: read when it is asked for, never on the way of a sample.

Needs the extra ``metrics``.
"""

from skyloop.metrics.catalogue import FAMILIES, Family, Reading
from skyloop.metrics.endpoint import Endpoint, Source, serve
from skyloop.metrics.sources import client_readings, proxy_readings, router_readings, serve_proxies, serving_beside

__all__ = [
    "FAMILIES",
    "Endpoint",
    "Family",
    "Reading",
    "Source",
    "client_readings",
    "proxy_readings",
    "router_readings",
    "serve",
    "serve_proxies",
    "serving_beside",
]
