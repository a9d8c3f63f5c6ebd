"""An emulated vehicle served by the driver: its AI-deck's frames, and poses from outside."""

from __future__ import annotations

import math
import struct
from contextlib import suppress
from pathlib import Path

import pytest

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import DriverError
from skyloop.messages import Encoding, LinkState
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.crazyflie.driver import CrazyflieDriver
from skyloop.vehicles.crazyflie.emulator import CrazyflieFirmware, with_crazyflies
from skyloop.vehicles.crazyflie.emulator.deck import DeckSettings
from skyloop.vehicles.crazyflie.wire.contents import MiscCommand, MiscMessage
from tests.vehicles.crazyflie.rig import Rig

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


def test_a_pose_from_outside_moves_the_vehicles_estimate() -> None:
    host = SimHost(with_crazyflies(SimOptions(world="empty", seed=1)))
    with CrazyflieFirmware(host, port=0) as firmware:
        driver, sink = CrazyflieDriver(parse_uri(firmware.address)), RecordingSink()
        driver.open(sink)

        def is_there() -> bool:
            with suppress(DriverError):  # no data from the vehicle yet
                driver.external_pose(ExternalPose((0.5, -0.25, 0.0), (0.0, 0.0, 0.0, 1.0), monotonic_ns()))
            position = None if sink.newest is None else sink.newest.position_m
            return position is not None and math.dist(position[:2], (0.5, -0.25)) < 0.05

        try:
            assert sink.wait(is_there, WITHIN_S)
            assert not [each for each in driver.checkup() if each.severe]
        finally:
            driver.close()


def test_no_pose_is_sent_to_a_vehicle_that_is_not_heard(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    with pytest.raises(DriverError, match="no data"):
        rig.session.send_pose(ExternalPose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), rig.now_ns), rig.now_ns)
    rig.session.on_datagram(b"", rig.now_ns)
    assert rig.session.counts["damaged"] == 1


def test_a_parameter_that_the_vehicle_changes_by_itself_has_its_new_value(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    session = rig.session
    (number,) = (n for n, entry in session.parameters.entries.items() if entry.full_name == "hlCommander.vland")
    updated = MiscMessage(MiscCommand.VALUE_UPDATED, number, struct.pack("<f", 0.125))
    session.on_datagram(updated.encode().encode(), rig.now_ns)
    assert session.values[number] == 0.125
    known = dict(session.values)
    session.on_datagram(MiscMessage(MiscCommand.VALUE_UPDATED, 9999, b"1234").encode().encode(), rig.now_ns)
    assert session.values == known
