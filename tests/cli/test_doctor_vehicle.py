"""``skyloop doctor ADDRESS`` on emulated autopilots."""

from __future__ import annotations

import pytest

from skyloop.cli import doctor
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors
from skyloop.vehicles.msp.emulator import BetaflightFirmware
from tests.support.betaflight import world
from tests.support.commands import Run


@pytest.mark.parametrize(
    ("kind", "name", "advice"),
    [(Kind.ARDUCOPTER, "ArduCopter 4.7.0", "fs_gcs_enable 7"), (Kind.PX4, "PX4 1.17.0", "com_obl_rc_act 5")],
)
def test_disabled_safety_nets_are_reported(run: Run, kind: Kind, name: str, advice: str) -> None:
    host = SimHost(with_multirotors(SimOptions(world="empty", speed=3.0)))
    with MavlinkFirmware(host, kind=kind, ports=Ports.free(kind)) as firmware:
        ended = run("doctor", firmware.address)
    assert ended.code == 0, ended.out
    assert f"✓ autopilot: {name}, system 1" in ended.out
    assert "– loss of this computer:" in ended.out
    assert f"→ skyloop param NAME mavlink.{advice}" in ended.out


def test_a_fault_that_ends_when_sticks_arrive_is_not_reported(run: Run) -> None:
    with BetaflightFirmware(world(), port=0) as firmware:
        ended = run("doctor", firmware.address)
    assert ended.code == 0, ended.out
    assert "✓ arming: it reports nothing that prevents arming" in ended.out
    assert "RXLOSS" not in ended.out


def test_a_vehicle_that_is_not_there(run: Run) -> None:
    ended = run("doctor", f"mavlink://udpin:127.0.0.1:{Ports.free(Kind.PX4).remote}")
    assert ended.code == 1
    assert "✗ vehicle: its link is lost: no message on udpin" in ended.out
    assert "→ point the vehicle at UDP port" in ended.out


def test_a_vehicle_that_has_not_been_looked_for_long_enough(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "ANSWER_S", 0.05)
    ended = run("doctor", f"mavlink://udpin:127.0.0.1:{Ports.free(Kind.PX4).remote}")
    assert ended.code == 1
    assert "✗ vehicle: its link is connecting" in ended.out


def test_an_invalid_address(run: Run) -> None:
    ended = run("doctor", "mavlink://nowhere")
    assert ended.code == 2
    assert "udpin" in ended.err
