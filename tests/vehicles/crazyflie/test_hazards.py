"""What could turn a motor that nobody asked for, drop a vehicle, or fail to stop one: one test for each way."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from skyloop.clock import nanoseconds
from skyloop.errors import DriverError
from skyloop.messages import (
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Land,
    LinkState,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.vehicles.crazyflie.options import OWN_LIMITS, VelocityMode
from skyloop.vehicles.crazyflie.parameters import vehicle_parameter
from skyloop.vehicles.crazyflie.setpoints import CrazyflieSetpoints
from skyloop.vehicles.crazyflie.telemetry import CrazyflieTelemetry
from skyloop.vehicles.crazyflie.wire.commander import (
    GoTo,
    HighLevelLand,
    HighLevelTakeoff,
    Message,
    Supervisor,
    is_finite,
)
from skyloop.vehicles.crazyflie.wire.contents import Entry, ValueType
from skyloop.vehicles.crazyflie.wire.crtp import DATA, CrtpPort
from tests.vehicles.crazyflie.rig import Rig, flying

STANDS = {f"stateEstimate.{name}": 0.0 for name in ("x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz")}


class Scripted:
    """Set-points, and the state that a vehicle reports 50 times a second."""

    def __init__(self, values: Mapping[str, float]) -> None:
        self.telemetry = CrazyflieTelemetry()
        self.setpoints = CrazyflieSetpoints(
            self.telemetry, VelocityMode.HIGH_LEVEL, {limit.name: limit.usual for limit in OWN_LIMITS}
        )
        self.now_ns = nanoseconds(100)
        self.values = {**STANDS, **values}
        self.silent = False
        self.run(0.1)

    def run(self, seconds: float) -> list[str]:
        """Return the names of the messages sent during a time."""
        sent: list[Message] = []
        for _ in range(round(seconds / 0.02)):
            self.now_ns += nanoseconds(0.02)
            if not self.silent:
                self.telemetry.update(self.values, self.now_ns)
                self.setpoints.on_state(self.now_ns)
            sent += self.setpoints.messages(self.now_ns)
        return [type(message).__name__ for message in sent]


class Losing:
    """Loses the first messages of a kind on their way to the vehicle."""

    def __init__(self, kind: type[Message], count: int) -> None:
        self.kind, self.left = kind, count

    def __call__(self, message: Message | None) -> bool:
        if not isinstance(message, self.kind) or not self.left:
            return True
        self.left -= 1
        return False


def lowest_m(rig: Rig, seconds: float) -> float:
    heights = []
    for _ in range(round(seconds / 0.01)):
        rig.step()
        heights.append(rig.simulation.truth(0).position_m[2])
    return min(heights)


def only_main(rig: Rig) -> None:
    """Lose all log data but the state."""
    rig.keeps = lambda packet: (
        (packet.port, packet.channel) != (CrtpPort.LOG, DATA) or packet.data[0] <= rig.session._main
    )


# Low-level set-points end --------------------------------------------------------------------------------------------


def test_the_motors_run_on_when_the_hover_after_set_points_is_lost(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.apply(Attitude(pitch=0.02))
    rig.run(0.5)
    rig.passes = Losing(GoTo, 3)
    rig.apply(Hover())
    assert lowest_m(rig, 4.0) > 0.7
    assert rig.state is FlightState.HOVERING


def test_the_motors_run_on_when_the_landing_after_set_points_is_lost(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.apply(Attitude(pitch=0.02))
    rig.run(0.5)
    rig.passes = Losing(HighLevelLand, 3)
    rig.apply(Land())
    assert lowest_m(rig, 1.2) > 0.6
    rig.until(lambda: rig.state is FlightState.LANDED, 8.0)


def test_ever_new_velocities_after_set_points_do_not_prevent_the_handover(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.apply(Attitude(pitch=0.02))
    rig.run(0.5)
    for number in range(150):
        rig.apply(Velocity(forward=0.1 + number / 2000))
        rig.run(0.02)
        assert rig.simulation.truth(0).position_m[2] > 0.7


# Reports that are too old, or missing --------------------------------------------------------------------------------


def test_old_reports_of_the_motors_neither_end_a_flight_nor_confirm_a_stop(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.run(1.0)
    only_main(rig)  # the last report: off
    rig.apply(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 8.0)
    rig.run(1.0)
    assert rig.state is FlightState.HOVERING
    rig.deaf = True
    rig.apply(EmergencyStop())
    rig.run(2.0)
    assert rig.kinds().count("EmergencyStopMessage") >= 18
    assert not rig.session.setpoints.stop.shown


def test_a_landing_is_not_over_because_an_old_report_says_motors_off(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.apply(Land())
    rig.until(lambda: rig.state is FlightState.LANDED, 10.0)
    rig.run(4.0)
    only_main(rig)  # the last report: off
    rig.apply(Takeoff())
    rig.until(lambda: rig.simulation.truth(0).position_m[2] > 0.9, 8.0)
    rig.run(1.5)
    rig.apply(Land())
    rig.run(0.1)
    assert rig.state is FlightState.LANDING


def test_what_is_not_known_to_stand_is_stopped_again_and_not_started() -> None:
    vehicle = Scripted({})
    with pytest.raises(DriverError, match="whether it flies"):
        vehicle.setpoints.apply(Takeoff(), vehicle.now_ns)
    vehicle.setpoints.apply(EmergencyStop(), vehicle.now_ns)
    assert vehicle.run(2.0).count("EmergencyStopMessage") >= 18


def test_a_vehicle_that_may_rise_unseen_is_not_disarmed() -> None:
    bits = Supervisor.IS_ARMED | Supervisor.CAN_FLY
    vehicle = Scripted({"supervisor.info": bits})
    vehicle.setpoints.apply(Takeoff(), vehicle.now_ns)
    assert "HighLevelTakeoff" in vehicle.run(0.1)
    vehicle.setpoints.on_answer(7, 0, vehicle.now_ns)
    vehicle.run(1.4)
    vehicle.silent = True
    assert vehicle.run(1.4) == []
    vehicle.silent, vehicle.values["supervisor.info"] = False, bits | Supervisor.IS_FLYING
    assert vehicle.run(0.5) == []


def test_a_velocity_is_not_sent_to_a_vehicle_that_may_have_landed_unseen(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.apply(Velocity(forward=0.2))
    rig.run(1.0)
    rig.mute = True
    rig.run(0.45)
    before = len(rig.sent)
    rig.run(0.8)
    assert rig.sent[before:] == []


# Landings and stops get through --------------------------------------------------------------------------------------


def test_a_takeoff_whose_rise_was_not_seen_is_landed(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.run(0.3)
    rig.apply(Takeoff())
    rig.mute = True
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    assert rig.simulation.truth(0).position_m[2] > 0.2
    rig.apply(Land())
    rig.until(lambda: not rig.simulation.feedback(0).state.airborne, 10.0)
    assert rig.kinds().count("HighLevelLand") <= 4  # once it has landed, another would start the motors


def test_a_landing_that_was_not_answered_is_sent_again(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.passes = lambda message: not isinstance(message, HighLevelLand)
    rig.apply(Land())
    rig.run(1.5)
    rig.passes = lambda _: True
    rig.until(lambda: rig.state is FlightState.LANDED, 7.0)


def test_a_stop_for_a_lost_vehicle_is_sent_in_all_layouts(tmp_path: Path) -> None:
    rig = flying(tmp_path, protocol=7)
    rig.on = False
    rig.until(lambda: rig.sink.link_state is LinkState.LOST, 3.0)
    rig.apply(EmergencyStop())
    assert rig.stops == {CrtpPort.LOCALISATION, CrtpPort.SUPERVISOR}


def test_even_a_repeated_stop_reaches_a_vehicle_that_is_left_alone() -> None:
    vehicle = Scripted({"supervisor.info": Supervisor.IS_FLYING})
    vehicle.setpoints.left_alone = True
    vehicle.setpoints.apply(EmergencyStop(), vehicle.now_ns, new=False)
    assert "EmergencyStopMessage" in vehicle.run(0.1)


# Nothing starts by itself --------------------------------------------------------------------------------------------


def test_a_repeat_does_not_take_over_what_another_client_flies(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.ready()
    rig.logic.receive(HighLevelTakeoff(0, 0.8, 0.0, True, 1.5).encode())
    rig.until(lambda: rig.state is FlightState.HOVERING, 6.0)
    for action in (Hover(), Velocity(up=0.3), Attitude()):
        rig.apply(action, new=False)
        rig.run(0.3)
    assert rig.sent == []
    rig.apply(Hover())
    rig.run(0.3)
    assert "GoTo" in rig.kinds()


def test_arming_ends_earlier_flights_first() -> None:
    vehicle = Scripted({"supervisor.info": Supervisor.CAN_BE_ARMED})
    vehicle.setpoints.apply(Takeoff(), vehicle.now_ns)
    assert vehicle.run(0.1) == ["HighLevelStop", "Arm"]


def test_recovery_after_a_crash_ends_earlier_flights_first(tmp_path: Path) -> None:
    rig = flying(tmp_path)
    rig.logic.flight.crash()
    rig.until(lambda: rig.session.telemetry.is_set(Supervisor.IS_CRASHED), 1.0)
    rig.run(3.0)
    before = len(rig.sent)
    rig.apply(ResetEmergency())
    rig.run(0.1)
    assert [type(message).__name__ for _, message in rig.sent[before:]] == ["HighLevelStop", "Recover"]


@pytest.mark.parametrize("lost", [False, True])
def test_a_vehicle_armed_in_vain_is_disarmed(lost: bool) -> None:
    vehicle = Scripted({"supervisor.info": Supervisor.CAN_BE_ARMED})
    vehicle.setpoints.apply(Takeoff(), vehicle.now_ns)
    assert "Arm" in vehicle.run(0.1)
    if lost:
        vehicle.setpoints.lost(vehicle.now_ns)
        vehicle.telemetry.forget()
    vehicle.values["supervisor.info"] = Supervisor.IS_ARMED | Supervisor.CAN_FLY
    sent = vehicle.run(5.0)
    assert sent.count("Arm") == 1
    assert ("HighLevelTakeoff" in sent) is not lost


def test_no_number_is_sent_that_a_vehicle_cannot_read() -> None:
    assert not is_finite(GoTo(0, False, False, 1e39, 0.0, 0.0, 0.0, 1.0))
    assert not is_finite(GoTo(0, False, False, float("nan"), 0.0, 0.0, 0.0, 1.0))


def test_the_idle_thrust_can_only_be_read() -> None:
    assert vehicle_parameter(Entry(0, "powerDist", "idleThrust", ValueType.UINT32), 0).read_only
