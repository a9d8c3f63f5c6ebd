"""An emulated vehicle with an AI-deck, served by the driver: frames and telemetry come together."""

from __future__ import annotations

import pytest

from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.messages import Encoding, LinkState
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.crazyflie.driver import CrazyflieDriver
from skyloop.vehicles.crazyflie.emulator import CrazyflieFirmware, with_crazyflies
from skyloop.vehicles.crazyflie.emulator.deck import DeckSettings

WITHIN_S = 20.0


@pytest.mark.parametrize(("stream", "more"), [("grey", ""), ("bayer", "&deck_colour=1"), ("state", "")])
def test_a_vehicle_with_a_deck_sends_frames_beside_its_telemetry(stream: str, more: str) -> None:
    if more:
        pytest.importorskip("cv2")
    host = SimHost(with_crazyflies(SimOptions(world="room", seed=1)))
    with CrazyflieFirmware(host, port=0, deck=DeckSettings(stream, port=0)) as firmware:
        driver, sink = CrazyflieDriver(parse_uri(firmware.address + more)), RecordingSink()
        (camera,) = driver.capabilities().cameras
        driver.open(sink)
        try:
            assert sink.wait(
                lambda: (
                    sink.link_state is LinkState.UP
                    and sink.frame_counts["front"] >= 5
                    and sink.newest is not None
                    and bool((sink.newest.native or {}).get("deck.frames"))
                ),
                WITHIN_S,
            )
        finally:
            driver.close()
    assert sink.problems == []
    assert sink.newest is not None
    assert {frame.encoding for frame in sink.frames} == {camera.encoding}
    assert camera.encoding is (Encoding.BGR8 if more else Encoding.MONO8)
    assert ("deck.position_m.z" in (sink.newest.native or {})) == (stream == "state")


def test_a_vehicle_without_a_deck_has_no_camera() -> None:
    driver = CrazyflieDriver(parse_uri("crazyflie://udp:127.0.0.1"))
    assert driver.capabilities().cameras == ()
