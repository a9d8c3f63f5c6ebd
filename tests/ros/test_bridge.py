"""The bridge between a proxy in this process and an rclpy that stores published messages (``fake_rclpy.py``)."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from skyloop.errors import MissingExtraError, UnsupportedError, UsageError
from skyloop.messages import EmergencyStop, FlightState, Position, Velocity
from skyloop.proxy.proxy import Proxy
from skyloop.ros import Bridge, Settings
from skyloop.ros.names import FrameNames, namespaces_of, tf_message_type
from skyloop.transport.memory import MemoryServer
from skyloop.vehicles.ros2.node import (
    DISCOVERY_VARIABLES,
    OLD_PROFILES_VARIABLE,
    PROFILES_VARIABLE,
    domain_of,
    ros_name,
    stay_on_this_machine,
)
from tests.support.fake_rclpy import Fake, Message, Node
from tests.support.fake_vehicle import FakeVehicle

WAIT_S = 10.0


class Rig:
    """A drone, its bridge, and the two nodes."""

    def __init__(self, fake: Fake, vehicle: FakeVehicle, bridge: Bridge) -> None:
        self.vehicle = vehicle
        self.bridge = bridge
        self.drone = bridge.drones["alpha-1"]
        self.node: Node = fake.nodes["skyloop"]
        self.commands: Node = fake.nodes["skyloop_commands"]

    def published(self, topic: str, since: int = 0) -> Any:
        until(lambda: len(self.node.publishers[topic].published) > since, topic)
        return self.node.publishers[topic].newest


def until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, f"not within {WAIT_S} s: {what}"
        time.sleep(0.005)


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeVehicle]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")  # no profile is written for this process
    vehicle, server = FakeVehicle(), MemoryServer("alpha-1")
    proxy = Proxy(vehicle, server, name="alpha-1")
    proxy.start()
    monkeypatch.setattr("skyloop.ros.bridge.dial_by_name", lambda name: server.dial)
    yield vehicle
    proxy.end()


@pytest.fixture
def rig(rclpy: Fake, served: FakeVehicle) -> Iterator[Rig]:
    with Bridge(Settings(drones=("alpha-1",), map_frame="map")) as bridge:
        yield Rig(rclpy, served, bridge)
    assert rclpy.nodes["skyloop"].destroyed


def twist(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> Any:
    return Message(linear=Message(x=x, y=y, z=z), angular=Message(x=0.0, y=0.0, z=turn))


def goal(x: float, y: float, z: float, frame: str = "", yaw: float | None = None) -> Any:
    turn = Message(x=0.0, y=0.0, z=math.sin((yaw or 0.0) / 2), w=math.cos((yaw or 0.0) / 2))
    pose = Message(position=Message(x=x, y=y, z=z), orientation=turn)
    return Message(header=Message(frame_id=frame), pose=pose)


# From the drone ------------------------------------------------------------------------------------------------------


def test_state_and_unknown_values(rig: Rig) -> None:
    assert rig.node.namespace == "alpha_1"
    assert rig.published("state").data == "landed"
    assert rig.node.publishers["imu/data"].published == []  # the vehicle reports yaw and altitude only
    assert rig.node.publishers["odom"].published == []  # no position: nothing is invented
    assert rig.node.publishers["battery_state"].published == []
    assert rig.node.publishers["fix"].published == []


def test_a_vehicle_that_knows_its_position(rig: Rig) -> None:
    from skyloop.messages import Feedback, LinkState
    from skyloop.messages.feedback import EarthOrigin
    from skyloop.ros.names import RosTime
    from skyloop.ros.telemetry import RosTelemetry

    quiet = SimpleNamespace(
        on_feedback=lambda function: None,
        now_ns=5 * 10**9,
        capabilities=SimpleNamespace(cameras=()),
    )
    node: Any = Node("one", "", [])
    telemetry = RosTelemetry(node, quiet, RosTime(node, quiet), FrameNames("one"))  # type: ignore[arg-type]
    known = Feedback(
        captured_ns=4 * 10**9,
        state=FlightState.FLYING,
        vehicle_link=LinkState.UP,
        battery=0.5,
        battery_v=11.1,
        roll_rad=0.0,
        pitch_rad=0.3,
        yaw_rad=1.0,
        velocity_m_s=(1.0, 0.0, 0.0),
        position_m=(100.0, 200.0, 3.0),
        native=dict(EarthOrigin(47.0, 8.0, 400.0, 6_371_000.0).native()),
        owner="me",
    )
    telemetry.publish(known)
    imu = node.publishers["imu/data"].newest
    assert imu.header.frame_id == "one/base_link"
    assert imu.orientation_covariance[0] > 0.0
    assert imu.angular_velocity_covariance[0] == -1.0  # not measured
    odometry = node.publishers["odom"].newest
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("one/odom", "one/base_link")
    assert odometry.pose.pose.position.x == 100.0
    assert odometry.twist.twist.linear.x == pytest.approx(math.cos(0.3))
    assert math.isnan(odometry.twist.twist.angular.x)
    assert odometry.header.stamp.sec == node.now_ns // 10**9 - 1
    fix = node.publishers["fix"].newest
    assert fix.latitude > 47.0
    assert fix.longitude > 8.0
    assert math.isnan(fix.altitude)
    battery = node.publishers["battery_state"].newest
    assert (battery.percentage, battery.voltage) == (0.5, pytest.approx(11.1))
    assert node.publishers["velocity"].newest.header.frame_id == "one/base_link"
    assert b"one/base_link\0" in node.publishers["/tf"].newest
    assert node.publishers["/tf_static"].published == []
    assert node.publishers["pilot"].newest.data == "me"
    node.now_ns = 0  # a simulation's clock is unknown so far
    count = len(node.publishers["odom"].published)
    telemetry.publish(known)
    assert len(node.publishers["odom"].published) == count


def test_frames_with_subscribers(rig: Rig) -> None:
    for topic in ("image_raw", "camera_info", "image_raw/compressed"):
        rig.node.publishers[f"front/{topic}"].subscribers = 0
    [camera] = rig.bridge._cameras
    camera.update()
    assert not camera.watched
    for topic in ("image_raw", "camera_info", "image_raw/compressed"):
        rig.node.publishers[f"front/{topic}"].subscribers = 1
    stopping = threading.Event()
    shown: list[int] = []
    serving = threading.Thread(target=rig.bridge.run, args=(stopping, lambda: shown.append(1)))
    serving.start()
    image = rig.published("front/image_raw")
    assert (image.height, image.width, image.encoding, image.step) == (24, 32, "bgr8", 96)
    assert np.frombuffer(image.data, np.uint8).reshape(24, 32, 3).std() == 0.0
    assert image.header.frame_id == "alpha_1/front_optical_frame"
    assert rig.published("front/camera_info").k == [0.0] * 9  # the vehicle does not know them
    assert bytes(rig.published("front/image_raw/compressed").data[:2]) == b"\xff\xd8"
    stopping.set()
    serving.join()
    assert shown
    for topic in ("image_raw", "camera_info", "image_raw/compressed"):
        rig.node.publishers[f"front/{topic}"].subscribers = 0
    camera.update()
    assert camera._listener is None


def test_without_opencv_there_are_no_compressed_images(
    rig: Rig,
    rclpy: Fake,
    served: FakeVehicle,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    with Bridge(Settings(drones=("alpha-1",))):
        assert "front/image_raw/compressed" not in rclpy.nodes["skyloop"].publishers
        assert any("skyloop install vision" in line for line in rclpy.nodes["skyloop"].logger.lines)


# To the drone --------------------------------------------------------------------------------------------------------


def test_nothing_is_flown_without_the_authority(rig: Rig) -> None:
    rig.commands.subscriptions["cmd_vel"](twist(x=0.5))
    rig.commands.subscriptions["goal_pose"](goal(1.0, 0.0, 1.0))
    answer = rig.node.call("takeoff")
    assert not answer.success
    assert "call the service authority/request first" in answer.message
    assert rig.vehicle.applied == []
    assert any("cmd_vel is ignored" in line for line in rig.commands.logger.lines)
    plan = rig.node.call("go_to", Message(goal=goal(1.0, 0.0, 1.0), tolerance=0.0)).plan
    assert plan.poses == []


def test_a_flight_and_the_dead_mans_hover(rig: Rig) -> None:
    assert rig.node.call("authority/request").success
    assert rig.node.call("takeoff").success
    rig.commands.subscriptions["cmd_vel"](twist(x=0.5, turn=0.2))
    until(lambda: any(isinstance(each, Velocity) for each in rig.vehicle.applied), "a velocity")
    until(lambda: rig.vehicle.state is FlightState.HOVERING, "hover after half a second of silence")
    assert rig.commands.call("hover").success
    assert rig.node.call("land").success
    until(lambda: rig.published("state").data in ("landed", "landing"), "the topic reports the landing")
    assert rig.node.call("authority/release").success
    until(lambda: rig.node.publishers["pilot"].newest.data == "", "nobody flies")


def test_a_stop_does_not_wait_for_services_that_wait(rig: Rig) -> None:
    """Four services that waited for the drone once delayed the emergency stop."""
    assert {"hover", "emergency_stop"} <= rig.commands.services.keys()
    assert not {"hover", "emergency_stop"} & rig.node.services.keys()
    assert rig.commands.call("emergency_stop").success
    until(lambda: EmergencyStop() in rig.vehicle.applied, "the stop")


def test_velocities_do_not_end_a_landing(rig: Rig) -> None:
    from skyloop.ros.pilot import Pilot

    sent: list[str] = []
    landing, landed = threading.Event(), threading.Event()

    def land() -> None:
        landing.set()
        assert landed.wait(WAIT_S)

    names = ("takeoff", "hover", "return_to_start", "emergency_stop", "release_authority")
    drone: Any = SimpleNamespace(
        land=land, velocity=lambda **how: sent.append("velocity"), **dict.fromkeys(names, lambda: None)
    )
    topics: Any = Node("topics", "", [])
    services: Any = Node("services", "", [])
    pilot = Pilot(topics, services, drone, None, FrameNames("one"), priority=None, timeout_s=0.5)  # type: ignore[arg-type]
    waiting = threading.Thread(target=services.call, args=("land",))
    waiting.start()
    assert landing.wait(WAIT_S)
    topics.subscriptions["cmd_vel"](twist(x=0.5))
    topics.subscriptions["goal_pose"](goal(1.0, 2.0, 3.0))
    assert sent == []
    assert "cmd_vel is ignored during land" in topics.logger.lines
    landed.set()
    waiting.join()
    topics.subscriptions["cmd_vel"](twist(x=0.5))
    assert sent == ["velocity"]
    pilot.close()  # and nothing ends the landing at the end
    topics.subscriptions["cmd_vel"](twist(x=0.5))
    assert sent == ["velocity"]


def test_a_velocity_that_was_checked_before_a_landing_is_sent_before_it(rig: Rig) -> None:
    """The topic's thread lost the CPU between the check and the sending: the landing must wait for it."""
    from skyloop.ros.pilot import Pilot

    order: list[str] = []
    sending, go_on = threading.Event(), threading.Event()

    def velocity(**_: float) -> None:
        sending.set()
        assert go_on.wait(WAIT_S)
        order.append("velocity")

    names = ("takeoff", "hover", "return_to_start", "emergency_stop", "release_authority")
    drone: Any = SimpleNamespace(
        land=lambda: order.append("land"), velocity=velocity, **dict.fromkeys(names, lambda: None)
    )
    topics: Any = Node("topics", "", [])
    services: Any = Node("services", "", [])
    Pilot(topics, services, drone, None, FrameNames("one"), priority=None, timeout_s=0.5)  # type: ignore[arg-type]
    flying = threading.Thread(target=topics.subscriptions["cmd_vel"], args=(twist(x=0.5),))
    flying.start()
    assert sending.wait(WAIT_S)
    landing = threading.Thread(target=services.call, args=("land",))
    landing.start()
    landing.join(0.05)
    go_on.set()
    flying.join()
    landing.join()
    assert order == ["velocity", "land"]


def test_stamped_velocities_for_others_or_from_long_ago_are_ignored(rig: Rig) -> None:
    assert rig.node.call("authority/request").success
    assert rig.node.call("takeoff").success

    def send(frame: str, age_s: float) -> None:
        sec, nanosec = divmod(rig.node.now_ns - round(age_s * 1e9), 10**9)
        stamp = Message(sec=sec, nanosec=nanosec)
        header = Message(frame_id=frame, stamp=stamp)
        rig.commands.subscriptions["cmd_vel_stamped"](Message(header=header, twist=twist(y=0.3)))

    send("map", 0.0)
    send("alpha_1/base_link", 2.0)
    assert not any(isinstance(each, Velocity) for each in rig.vehicle.applied)
    assert any("must be alpha_1/base_link" in line for line in rig.commands.logger.lines)
    assert any("2 s old; the limit is 0.5 s" in line for line in rig.commands.logger.lines)
    send("alpha_1/base_link", 0.1)
    until(lambda: any(isinstance(each, Velocity) and each.left == 0.3 for each in rig.vehicle.applied), "a velocity")


def test_goals_of_other_frames_and_without_a_height_are_refused(rig: Rig) -> None:
    rig.node.call("authority/request")
    deliver = rig.commands.subscriptions["goal_pose"]
    for one, reason in (
        (goal(1.0, 2.0, 1.5, "camera"), "must be odom or alpha_1/odom or map"),
        (goal(1.0, 2.0, 0.0, "odom"), "give z"),
        (goal(math.nan, 2.0, 1.0), "must be finite"),
    ):
        deliver(one)
        assert any(reason in line for line in rig.commands.logger.lines), rig.commands.logger.lines
    assert not any(isinstance(each, Position) for each in rig.vehicle.applied)


def test_repeats_of_a_refused_goal_are_not_flown(rig: Rig) -> None:
    rig.vehicle.position_m = (0.0, 0.0, 1.0)
    rig.node.call("authority/request")
    assert rig.node.call("takeoff").success
    rig.commands.subscriptions["goal_pose"](goal(1.0, 0.0, -4.0))
    until(lambda: any("below the ground" in event.text for event in rig.drone.recent_events()), "it is refused")
    seq = rig.drone.feedback().seq
    rig.drone.wait(lambda feedback: feedback.seq > seq + 20, WAIT_S)
    assert not any(isinstance(each, Position) for each in rig.vehicle.applied)


def test_goals_are_positions_with_a_heading(rig: Rig) -> None:
    from skyloop.ros.pilot import Pilot

    flown: list[dict[str, Any]] = []
    drone = SimpleNamespace(
        go_to=lambda **how: flown.append(how),
        feedback=lambda: SimpleNamespace(position_m=(0.0, 0.0, 1.2)),
        **dict.fromkeys(
            ("takeoff", "land", "hover", "return_to_start", "emergency_stop", "release_authority"), lambda: False
        ),
    )
    topics: Any = Node("topics", "", [])
    services: Any = Node("services", "", [])
    Pilot(topics, services, drone, None, FrameNames("one"), priority=None, timeout_s=0.5)  # type: ignore[arg-type]
    topics.subscriptions["goal_pose"](goal(1.0, 2.0, 0.0, "one/odom", yaw=1.0))
    assert flown[0] == {"x": 1.0, "y": 2.0, "z": 1.2, "yaw": pytest.approx(1.0), "wait": False}
    topics.subscriptions["goal_pose"](goal(1.0, 2.0, 3.0))
    assert flown[1]["yaw"] is None
    answer = services.call("go_to", Message(goal=goal(1.0, 2.0, 3.0, "odom"), tolerance=0.5))
    assert flown[2]["tolerance_m"] == 0.5
    assert [pose.pose.position.z for pose in answer.plan.poses] == [1.2, 3.0]
    refused = topics.call("hover")
    assert (refused.success, "not sent" in refused.message) == (False, True)


# Parameters ----------------------------------------------------------------------------------------------------------


def ros_parameter(name: str, value: Any) -> Any:
    return SimpleNamespace(name=name, value=value)


def test_parameters_both_ways(rig: Rig) -> None:
    name = "limits.speed"
    assert rig.node.parameters[name] == rig.drone.config[name]
    descriptor = rig.node.descriptors[name]
    assert descriptor.floating_point_range[0].to_value > 0.0
    refused = rig.node.set_parameters([ros_parameter(name, 1.5)])
    assert not refused.successful
    assert "authority" in refused.reason
    rig.drone.request_authority()
    assert rig.node.set_parameters([ros_parameter(name, 1.5), ros_parameter("use_sim_time", True)]).successful
    assert rig.drone.config[name] == 1.5
    rig.drone.config[name] = 1.25  # as another application would
    until(lambda: rig.node.parameters[name] == 1.25, "the parameter at the node")


# Settings and names --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"drones": ()}, "at least one drone"),
        ({"drones": ("a",), "timeout_s": 0.0}, "time-out of cmd_vel"),
        ({"drones": ("a",), "priority": 32}, "from 0, the highest, to 31"),
        ({"drones": ("a-1", "a_1")}, "would both be /a_1"),
    ],
)
def test_invalid_settings(wrong: dict[str, Any], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        Settings(**wrong)


def test_names_that_ros_allows() -> None:
    assert ros_name("drone-3") == "drone_3"
    assert ros_name("3") == "drone_3"
    assert namespaces_of(("alpha", "b.c")) == {"alpha": "alpha", "b.c": "b_c"}
    assert FrameNames("alpha").optical("front") == "alpha/front_optical_frame"


def test_domains() -> None:
    assert domain_of(None) is None
    assert domain_of("42") == 42
    with pytest.raises(UsageError, match="'102'"):
        domain_of("102")


def test_a_priority_requests_the_authority_at_once_and_arguments_go_to_ros(rclpy: Fake, served: FakeVehicle) -> None:
    settings = Settings(drones=("alpha-1",), priority=4, use_sim_time=True, arguments=("-r", "cmd_vel:=teleop"))
    with Bridge(settings) as bridge:
        status = bridge.drones["alpha-1"].authority
        assert (status.state, status.priority) == ("held", 4)
        assert rclpy.arguments[-2:] == ["-r", "cmd_vel:=teleop"]
        assert rclpy.nodes["skyloop"].parameters["use_sim_time"] is True
    rclpy.refuses = RuntimeError("unknown remap")
    with pytest.raises(UsageError, match="unknown remap"), Bridge(settings):
        pass


def test_without_rclpy_the_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rclpy", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install ros"), Bridge(Settings(drones=("alpha",))):
        pass


def test_transforms_need_a_known_rclpy_or_the_package_of_their_type(
    rclpy: Fake,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert tf_message_type().__name__ == "TFMessage"
    monkeypatch.setitem(__import__("sys").modules, "tf2_msgs.msg", None)
    monkeypatch.setattr("skyloop.ros.names.version", lambda package: "7.1.6")
    with pytest.raises(UnsupportedError, match=r"not 7\.x with rmw_fastrtps_cpp"):
        tf_message_type()


def test_this_machine_only_unless_the_environment_configures_discovery() -> None:
    for variable in DISCOVERY_VARIABLES:
        environment = {variable: "something"}
        assert not stay_on_this_machine(environment)
        assert environment == {variable: "something"}
    alone: dict[str, str] = {}
    assert stay_on_this_machine(alone)
    assert stay_on_this_machine(alone)
    assert "<address>127.0.0.1</address>" in Path(alone[PROFILES_VARIABLE]).read_text()
    assert PROFILES_VARIABLE not in os.environ
    old = {"ROS_DISTRO": "humble"}
    assert stay_on_this_machine(old)
    assert "<address>127.0.0.1</address>" in Path(old[OLD_PROFILES_VARIABLE]).read_text()
    other = {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    assert stay_on_this_machine(other)
    assert other["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
