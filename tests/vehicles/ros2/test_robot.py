"""The driver of ``ros2://`` without rclpy: options, and the session between a robot's messages and the sink."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest

from skyloop.clock import ManualClock
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import DriverError, MissingExtraError, UnknownNameError, UsageError
from skyloop.messages import Encoding, FlightState, Hover, Idle, Land, LinkState, Takeoff, Velocity
from skyloop.vehicles.ros2.driver import Ros2Driver
from skyloop.vehicles.ros2.options import Options, options_of
from skyloop.vehicles.ros2.protocol import ANSWER_S, CaptureClock, RobotSession, battery_of, state_of
from tests.vehicles.ros2.messages import image, odometry, stamp

SERVED = "ros2://robot?takeoff=takeoff&land=land&width=4&height=2"
EPOCH_NS = 1_700_000_000 * 10**9


def options(address: str) -> Options:
    return options_of(parse_uri(address))


# Addresses -----------------------------------------------------------------------------------------------------------


def test_names_are_below_the_namespace_unless_they_begin_with_a_slash() -> None:
    found = options("ros2://fleet/robot?image=front/image_raw&cmd_vel=/mux/cmd_vel&battery=")
    assert (found.namespace, found.image) == ("/fleet/robot", "/fleet/robot/front/image_raw")
    assert (found.cmd_vel, found.odom, found.battery) == ("/mux/cmd_vel", "/fleet/robot/odom", "")
    assert found.info == "/fleet/robot/front/camera_info"
    assert options("ros2://").odom == "/odom"


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("ros2://1robot", "is not a ROS 2 namespace"),
        ("ros2://robot?image=front-image", "option image is 'front-image'"),
        ("ros2://robot?image=&odom=", "name at least one"),
        ("ros2://robot?takeoff=takeoff&ground=1", "does not leave the ground"),
        ("ros2://robot?takeoff=takeoff&cmd_vel=", "it needs cmd_vel"),
        ("ros2://robot?camera=a/b", "option camera"),
        ("ros2://robot?mount=sideways", "no mount of a camera"),
        ("ros2://robot?domain=200", "option domain"),
        ("ros2://robot?takof=x", "did you mean 'takeoff'"),
    ],
)
def test_invalid_addresses_are_refused_with_the_reason(address: str, reason: str) -> None:
    with pytest.raises((UsageError, UnknownNameError), match=reason):
        Ros2Driver(parse_uri(address))


def test_capabilities_follow_from_the_address() -> None:
    plain = Ros2Driver(parse_uri("ros2://robot")).capabilities()
    assert plain.actions == {"idle", "velocity"}
    assert plain.cameras[0].rotation is not None
    assert options(SERVED).capabilities().actions == {"idle", "velocity", "takeoff", "land"}
    assert options("ros2://robot?ground=1").capabilities().actions == {"idle", "velocity", "takeoff", "hover", "land"}
    watched = options("ros2://robot?cmd_vel=&mount=unknown&compressed=1").capabilities()
    assert watched.actions == frozenset()
    assert "cmd_vel" in watched.why_not
    assert (watched.cameras[0].rotation, watched.cameras[0].encoding) == (None, Encoding.JPEG)
    assert options("ros2://robot?image=").capabilities().cameras == ()


def test_an_unopened_driver_refuses_commands() -> None:
    driver = Ros2Driver(parse_uri(SERVED))
    with pytest.raises(DriverError, match="is not open"):
        driver.apply(Land())
    with pytest.raises(DriverError, match="is not open"):
        driver.apply(Land(), new=False)
    assert driver.failsafe(Hover()) is False
    driver.close()


def test_without_rclpy_the_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rclpy", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install ros"):
        Ros2Driver(parse_uri(SERVED)).open(RecordingSink())


# Messages ------------------------------------------------------------------------------------------------------------


def test_odometry_becomes_state_in_levelled_axes() -> None:
    found = state_of(odometry(0, z=1.5, pitch=0.3, forward=2.0), ground=False)
    assert found["position_m"] == (1.0, 2.0, 1.5)
    assert found["altitude_m"] == 1.5
    assert (found["pitch_rad"], found["yaw_rad"]) == pytest.approx((0.3, 0.5))
    assert found["velocity_m_s"] == pytest.approx((2.0 * math.cos(0.3), 0.0, -2.0 * math.sin(0.3)))
    assert found["angular_velocity_rad_s"] == (0.0, 0.0, 0.1)
    assert "altitude_m" not in state_of(odometry(0), ground=True)


def test_values_that_are_not_finite_are_unknown() -> None:
    bad = odometry(0)
    bad.pose.pose.position.x = math.nan
    bad.twist.twist.linear.y = math.inf
    found = state_of(bad, ground=False)
    assert "position_m" not in found
    assert "velocity_m_s" not in found
    assert found["yaw_rad"] == pytest.approx(0.5)
    bad.pose.pose.orientation.w = math.nan
    assert state_of(bad, ground=False) == {}


@pytest.mark.parametrize(("told", "known"), [(0.5, 0.5), (math.nan, None), (55.0, 0.55), (-1.0, None)])
def test_charge_is_a_share(told: float, known: float | None) -> None:
    assert battery_of(Message(percentage=told, voltage=math.nan)) == {"battery": known, "battery_v": None}


def test_stamps_of_the_systems_clock_and_of_another() -> None:
    clock = CaptureClock()
    now_ns = 10 * 10**9
    assert clock.captured_ns(EPOCH_NS - 30_000_000, now_ns, EPOCH_NS) == now_ns - 30_000_000
    assert clock.captured_ns(EPOCH_NS - 60_000_000, now_ns + 1, EPOCH_NS) == now_ns - 30_000_000  # never backwards
    assert clock.captured_ns(0, now_ns + 2, EPOCH_NS) == now_ns + 2  # no stamp: its arrival
    simulated = CaptureClock()
    assert simulated.captured_ns(5 * 10**9, now_ns, EPOCH_NS) == now_ns
    late_ns = now_ns + 30_000_000 + 8_000_000  # 30 ms later by its stamp, 38 ms by its arrival
    assert simulated.captured_ns(5_030_000_000, late_ns, EPOCH_NS) == now_ns + 30_000_000


# The session ---------------------------------------------------------------------------------------------------------


class FakeRobot:
    """Records sent velocities; services answer on the test's request."""

    def __init__(self) -> None:
        self.sent: list[Velocity] = []
        self.called: list[str] = []
        self.answer: Callable[[bool, str], None] | None = None
        self.offers = True

    def missing(self) -> str:
        return "" if self.offers else "/robot/takeoff"

    def send(self, velocity: Velocity) -> None:
        self.sent.append(velocity)

    def call(self, service: str, answered: Callable[[bool, str], None]) -> None:
        if not self.offers:
            raise DriverError(f"no node offers the service {service}")
        self.called.append(service)
        self.answer = answered


class Rig:
    """A session with its clock, sink and robot."""

    def __init__(self, address: str = SERVED) -> None:
        self.clock = ManualClock()
        self.sink = RecordingSink()
        self.robot = FakeRobot()
        self.session = RobotSession(options(address), self.sink, self.robot, self.clock, self.system)

    def system(self) -> int:
        return EPOCH_NS + self.clock()

    def tell(self, **how: Any) -> FlightState:
        self.session.on_odometry(odometry(self.system(), **how))
        assert self.sink.newest is not None
        return self.sink.newest.state

    def answer(self, success: bool, text: str = "") -> None:
        assert self.robot.answer is not None
        self.robot.answer(success, text)


def test_a_flight_by_services_and_velocities() -> None:
    rig = Rig()
    assert rig.tell() is FlightState.LANDED
    rig.session.command(Takeoff())
    rig.session.command(Takeoff(), new=False)  # under way: not called again
    assert rig.robot.called == ["/robot/takeoff"]
    assert rig.tell(z=0.05) is FlightState.TAKING_OFF
    rig.answer(True)
    assert rig.tell(z=1.0) is FlightState.HOVERING
    rig.session.command(Takeoff(), new=False)  # it is in the air
    rig.session.command(Velocity(forward=0.5))
    assert rig.tell(z=1.0) is FlightState.FLYING
    rig.session.tick()
    assert rig.robot.sent == [Velocity(forward=0.5)] * 2
    rig.session.command(Land())
    rig.session.tick()
    assert len(rig.robot.sent) == 2  # a landing robot gets no velocities
    assert rig.tell(z=0.5) is FlightState.LANDING
    rig.answer(True)
    assert rig.tell() is FlightState.LANDED
    rig.session.command(Land())
    assert rig.robot.called == ["/robot/takeoff", "/robot/land"]  # it is already on the ground


def test_a_refused_take_off_is_reported_and_over() -> None:
    rig = Rig()
    rig.tell()
    rig.session.command(Takeoff())
    rig.answer(False, "propellers blocked")
    assert rig.tell() is FlightState.LANDED
    assert "refused /robot/takeoff: propellers blocked" in rig.sink.events[-1].text
    rig.robot.offers = False
    with pytest.raises(DriverError, match="no node offers"):
        rig.session.command(Takeoff())
    assert rig.tell() is FlightState.LANDED


@pytest.mark.parametrize("answer", ["no service", "refused", "none"])
def test_a_robot_whose_landing_fails_stops(answer: str) -> None:
    """A robot without a watchdog once kept its last velocity, as it got no other."""
    rig = Rig()
    rig.tell(z=1.0)
    rig.session.command(Velocity(forward=0.5))
    rig.robot.offers = answer != "no service"
    if rig.robot.offers:
        rig.session.command(Land())
    else:
        with pytest.raises(DriverError, match="no node offers"):
            rig.session.command(Land())
    if answer == "refused":
        rig.answer(False, "not now")
    if answer == "none":
        rig.clock.advance(ANSWER_S + 0.1)
        rig.session.tick()
    rig.session.tick()
    assert rig.robot.sent[-1] == Velocity()


def test_repeats_of_a_refused_take_off_do_not_call_the_service() -> None:
    """A person who frees the propellers meanwhile must not be below a robot that takes off."""
    rig = Rig()
    rig.tell()
    rig.session.command(Takeoff())
    rig.answer(False, "propellers blocked")
    with pytest.raises(DriverError, match="propellers blocked"):
        rig.session.command(Takeoff(), new=False)
    assert rig.robot.called == ["/robot/takeoff"]
    rig.session.command(Takeoff())
    rig.answer(True)
    rig.session.command(Takeoff(), new=False)
    assert rig.robot.called == ["/robot/takeoff"] * 2


def test_a_successful_take_off_can_be_withdrawn_before_it_shows() -> None:
    """The service answers before the robot rises: by its odometry it is on the ground, and still has to be landed."""
    rig = Rig()
    for _ in range(2):
        rig.tell()
        rig.session.command(Takeoff())
        rig.answer(True)
        rig.tell(z=1.0)
        rig.session.command(Land())
        rig.answer(True)
        rig.tell()
    rig.robot.called.clear()
    rig.session.command(Takeoff())
    rig.answer(True)
    assert rig.tell() is FlightState.LANDED
    rig.session.command(Takeoff(), new=False)
    assert rig.robot.called == ["/robot/takeoff"], "nor is the service called twice"
    rig.session.command(Land(), new=False)
    assert rig.robot.called == ["/robot/takeoff", "/robot/land"]


def test_the_wait_for_a_services_answer_is_limited() -> None:
    rig = Rig()
    rig.tell()
    rig.session.command(Takeoff())
    rig.clock.advance(ANSWER_S + 0.1)
    rig.session.tick()
    assert rig.tell() is FlightState.LANDED


def test_a_take_off_does_not_wait_for_a_silent_robot() -> None:
    """ROS delivers the call when the robot runs again, and it would take off then."""
    rig = Rig()
    rig.tell()
    rig.clock.advance(rig.session._options.timeout_s + 0.1)
    with pytest.raises(DriverError, match="no data from the robot"):
        rig.session.command(Takeoff())
    assert rig.robot.called == []
    rig.tell()
    rig.session.command(Takeoff())
    assert rig.robot.called == ["/robot/takeoff"]


def test_repeats_of_an_unanswered_take_off_do_not_call_the_service() -> None:
    rig = Rig()
    rig.tell()
    rig.session.command(Takeoff())
    rig.clock.advance(ANSWER_S + 0.1)
    rig.session.tick()
    rig.tell()
    rig.session.command(Takeoff(), new=False)
    assert rig.robot.called == ["/robot/takeoff"]


def test_a_robot_without_images_is_stopped() -> None:
    rig = Rig(f"{SERVED}&odom=")
    rig.session.on_image(image(rig.system()))
    rig.session.command(Velocity(forward=0.5))
    for _ in range(100):
        rig.clock.advance(0.05)
        rig.session.tick()
    assert rig.sink.link_state is LinkState.LOST
    assert rig.robot.sent[-1] == Velocity()


def test_without_odometry_the_services_show_whether_it_flies() -> None:
    rig = Rig(f"{SERVED}&odom=")
    rig.session.on_image(image(rig.system()))
    rig.clock.advance(0.2)
    rig.session.tick()
    assert rig.sink.feedbacks[-1].state == "unknown"
    rig.session.command(Takeoff())
    rig.answer(True)
    rig.clock.advance(0.2)
    rig.session.tick()
    assert rig.sink.feedbacks[-1].state == "hovering"
    assert rig.sink.feedbacks[-1].position_m is None


def test_late_odometry_after_images_alone_does_not_run_backwards() -> None:
    rig = Rig()
    rig.session.on_image(image(rig.system()))
    rig.clock.advance(0.2)
    rig.session.tick()
    rig.session.on_odometry(odometry(rig.system() - 300_000_000))  # captured before the image
    rig.clock.advance(0.2)
    rig.session.tick()  # missing odometry is not invented
    assert rig.sink.feedback_count == 2
    assert not rig.sink.problems


def test_a_ground_robot_drives_between_take_off_and_landing() -> None:
    rig = Rig("ros2://robot?ground=1")
    assert rig.tell() is FlightState.LANDED
    rig.session.command(Takeoff())
    assert rig.tell() is FlightState.HOVERING
    rig.session.command(Velocity(forward=0.2))
    assert rig.tell() is FlightState.FLYING
    rig.session.command(Hover())
    assert rig.robot.sent[-1] == Velocity()
    rig.session.command(Land())
    assert rig.tell() is FlightState.LANDED
    assert rig.robot.called == []


def test_closing_stops_the_robot() -> None:
    rig = Rig()
    rig.session.command(Velocity(left=0.3))
    rig.session.close()
    rig.session.close()
    assert rig.robot.sent == [Velocity(left=0.3), Velocity()]
    idle = Rig()
    idle.session.command(Velocity(left=0.3))
    idle.session.command(Idle())
    idle.session.close()
    assert idle.robot.sent == [Velocity(left=0.3)]


def test_the_link_is_lost_with_a_reason_and_found_again() -> None:
    rig = Rig()
    rig.clock.advance(1.5)
    rig.session.tick()
    rig.session.tick()
    assert [state for state, _ in rig.sink.links] == [LinkState.LOST]
    assert "no messages on /robot/odom and /robot/image_raw for 1.5 s" in rig.sink.links[0][1]
    assert "ROS_DOMAIN_ID" in rig.sink.remedy
    rig.tell()
    assert rig.sink.link_state is LinkState.UP
    assert not rig.sink.problems


def test_a_robot_without_its_services_is_degraded() -> None:
    rig = Rig()
    rig.robot.offers = False
    rig.tell()
    assert rig.sink.links == []  # they may be discovered a little later than its topics
    rig.clock.advance(6.0)
    rig.tell()
    rig.tell()
    assert rig.sink.links == [(LinkState.DEGRADED, "no node offers the service /robot/takeoff")]
    assert "correct its name" in rig.sink.remedy
    rig.robot.offers = True
    rig.tell()
    assert rig.sink.link_state is LinkState.UP


def test_frames_have_the_cameras_intrinsics_and_other_sizes_are_reported_once() -> None:
    rig = Rig()
    info = Message(k=[9.0, 0.0, 2.0, 0.0, 9.0, 1.0, 0.0, 0.0, 1.0], d=[0.0] * 5, distortion_model="plumb_bob")
    rig.session.on_info(info)
    rig.session.on_battery(Message(percentage=0.7, voltage=11.0))
    rig.session.on_image(image(rig.system() - 20_000_000))
    [frame] = rig.sink.frames
    assert (frame.width, frame.height, frame.encoding) == (4, 2, Encoding.BGR8)
    assert frame.intrinsics is not None
    assert frame.captured_ns == rig.clock() - 20_000_000
    info.k[1] = 0.4
    for _ in range(2):
        rig.session.on_info(info)
    assert [event.text for event in rig.sink.events] == [
        "the camera's pixels have a skew of 0.4 px, which is ignored: calibrate without it"
    ]
    info.distortion_model, info.d = "equidistant", [0.1] * 8
    rig.session.on_info(info)
    assert "intrinsics can't be used: lens model 'equidistant' has at most 4" in rig.sink.events[-1].text
    rig.session.on_image(image(rig.system()))
    assert rig.sink.frames[-1].intrinsics is None, "and no exception in the application"
    rig.sink.events.clear()
    rig.sink.frames.clear()
    rig.session.on_image(image(rig.system()))
    for _ in range(2):
        rig.session.on_image(image(rig.system(), width=8))
    rig.session.on_image(image(rig.system(), encoding="bayer"))
    assert [event.text for event in rig.sink.events] == [
        "images are 8×2: write width=8&height=2 into the address",
        rig.sink.events[1].text,
    ]
    assert "encoding 'bayer'" in rig.sink.events[1].text
    rig.sink.watch = set()
    rig.session.on_image(image(rig.system()))
    assert len(rig.sink.frames) == 1
    assert rig.tell() is FlightState.LANDED
    assert rig.sink.newest is not None
    assert rig.sink.newest.battery == 0.7


def test_jpeg_is_passed_on_unchanged() -> None:
    cv2 = pytest.importorskip("cv2")
    rig = Rig(f"{SERVED}&compressed=1")
    _, encoded = cv2.imencode(".jpg", np.zeros((2, 4, 3), np.uint8))
    rig.session.on_image(Message(header=stamp(rig.system()), format="jpeg", data=encoded.tobytes()))
    [frame] = rig.sink.frames
    assert frame.encoding is Encoding.JPEG
    rig.session.on_image(Message(header=stamp(rig.system()), format="png", data=b"\x89PNG"))
    rig.session.on_image(Message(header=stamp(rig.system()), format="jpeg", data=b"\xff\xd8\x00"))
    assert ["'png'" in rig.sink.events[0].text, "its size" in rig.sink.events[1].text] == [True, True]
    assert not rig.sink.problems


def test_the_end_of_odometry_is_reported_and_ends_the_velocity() -> None:
    rig = Rig()
    rig.tell(z=1.0)
    rig.session.command(Velocity(forward=0.5))
    for _ in range(40):
        rig.clock.advance(0.05)
        rig.session.on_image(image(rig.system()))
        rig.session.tick()
    assert rig.sink.links[-1][0] is LinkState.DEGRADED
    assert "no messages on /robot/odom for 1." in rig.sink.links[-1][1]
    assert len(rig.sink.links) == 2, "told once"
    assert rig.robot.sent[-1] == Velocity()
    assert sum(each != Velocity() for each in rig.robot.sent) < 25
    assert rig.sink.newest is not None
    assert rig.sink.newest.altitude_m is None
    assert rig.sink.newest.state is FlightState.UNKNOWN
    rig.session.command(Velocity(up=-0.3))
    for _ in range(3):
        rig.session.tick()
    assert rig.robot.sent[-1] == Velocity(up=-0.3), "further commands are obeyed, as they may land it"
    rig.session.command(Land())
    assert rig.robot.called == ["/robot/land"]
    rig.answer(True)
    rig.tell()
    assert rig.sink.link_state is LinkState.UP


def test_a_robot_with_planar_odometry_is_landed() -> None:
    """Its z is always 0: only its services show whether it flies."""
    rig = Rig()
    rig.tell()
    rig.session.command(Takeoff())
    rig.answer(True)
    assert rig.tell() is FlightState.HOVERING
    rig.session.command(Land())
    assert rig.robot.called == ["/robot/takeoff", "/robot/land"]
    assert rig.tell() is FlightState.LANDING
    rig.answer(True)
    assert rig.tell() is FlightState.LANDED


def test_a_robot_in_an_unknown_state_is_landed() -> None:
    """It may have been in the air before the proxy started; its odometry was never above the ground."""
    rig = Rig()
    rig.tell()
    rig.session.command(Land(), new=False)
    assert rig.robot.called == []
    rig.session.command(Land())
    assert rig.robot.called == ["/robot/land"]
