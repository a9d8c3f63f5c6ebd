"""The network transport, built on Eclipse Zenoh.

``docs/network.md`` explains how to use it, and ``docs/wire-format.md`` describes its packets. The package needs the
``network`` extra. If that is not installed, every function here raises :class:`MissingExtraError`.
"""

from __future__ import annotations

from skyloop.network.client import dial
from skyloop.network.config import FabricSettings, TlsFiles, choose
from skyloop.network.discovery import list_proxies
from skyloop.network.packets import ProxyInfo
from skyloop.network.server import FabricServer

__all__ = ["FabricServer", "FabricSettings", "ProxyInfo", "TlsFiles", "choose", "dial", "list_proxies"]
