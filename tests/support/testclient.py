"""Starlette's test client, whichever of the libraries that it can use is installed."""

from __future__ import annotations

import warnings

with warnings.catch_warnings():
    # It asks for another HTTP library with a warning, and works with this one.
    warnings.filterwarnings("ignore", message="Using `httpx` with `starlette.testclient`")
    from starlette.testclient import TestClient, WebSocketTestSession

__all__ = ["TestClient", "WebSocketTestSession"]
