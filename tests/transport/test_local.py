"""The local transport keeps the contract."""

from __future__ import annotations

import itertools

import pytest

from skyloop.transport.base import Dialer, TransportServer
from skyloop.transport.conformance import TransportSuite
from skyloop.transport.local import LocalServer, dial

pytestmark = pytest.mark.usefixtures("side")
_names = (f"suite-{number}" for number in itertools.count())


class TestLocal(TransportSuite):
    def make_server(self) -> TransportServer:
        return LocalServer(next(_names))

    def dialer(self, server: TransportServer) -> Dialer:
        return dial(server.address.removeprefix("local:"))
