"""A safety pilot changes the mode while a page flies: an emulated autopilot, and the proxy's messages to it."""

from __future__ import annotations

from pathlib import Path

import pytest

from skyloop.cockpit.discovery import FoundProxy
from skyloop.cockpit.fleet import CockpitFleet
from skyloop.transport.testing import wait_until
from skyloop.vehicles.mavlink.emulator import Kind
from tests.promises.faults.scene import KINDS, Scene, taken_off
from tests.support.cockpit import cockpit
from tests.support.cockpit_page import page

pytestmark = pytest.mark.timeout(60)


class Finder:
    """Finds the proxy of a scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def __call__(self) -> list[FoundProxy]:
        return [FoundProxy("alpha", "memory", self._scene.server.dial)]

    def add_name(self, name: str) -> None: ...

    def close(self) -> None: ...


@KINDS
def test_a_page_flying_to_a_place_yields_to_a_mode_change(kind: Kind, tmp_path: Path) -> None:
    """The page's own hover put it back into GUIDED 0.6 s later, and so did closing the page."""
    with Scene(kind, tmp_path / "alpha.flight") as scene:
        proxy = scene.proxy()
        with taken_off(scene), cockpit(CockpitFleet(Finder(scene), search_s=0.05)) as client:
            with page(client) as pilot, pilot.staying():
                pilot.take(4)
                pilot.say("goto", x=80, y=0, z=6)
                pilot.wait("sent", do="goto")
                wait_until(lambda: scene.set_points > 5, "it flies there")
                scene.station_mode("RTL")
                wait_until(lambda: scene.mode.endswith("RTL"), "it is in that mode")
                scene.ours.clear()
                pilot.wait("refused", do="goto")
                scene.watched(proxy)
                assert scene.ours == []
                assert scene.mode.endswith("RTL")
            scene.watched(proxy)
            assert scene.ours == []
            assert scene.mode.endswith("RTL")
