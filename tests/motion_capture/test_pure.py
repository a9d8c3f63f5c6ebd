"""Motion capture without a system: addresses, axes, tracks, calibration."""

from __future__ import annotations

import io
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.motion_capture import BodyPose, TrackState, calibrate, parse_system
from skyloop.motion_capture.pose import Quaternion, Track, Vector, mean_quaternion, multiply, plausible, z_up
from skyloop.motion_capture.source import LENGTH, RawFrame, read, write

MS = 1_000_000
UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)
angles = st.floats(-3.0, 3.0)


@pytest.mark.parametrize(
    ("address", "kind", "up", "configuration"),
    [
        ("vicon://192.168.0.10", "vicon", "z", {"hostname": "192.168.0.10"}),
        ("vicon://lab:801?latency=0.004", "vicon", "z", {"hostname": "lab:801"}),
        ("optitrack://10.0.0.2", "optitrack", "y", {"hostname": "10.0.0.2"}),
        (
            "optitrack://h?up=z&interface=10.0.0.3&port=1510",
            "optitrack",
            "z",
            {"hostname": "h", "interface_ip": "10.0.0.3", "port_command": "1510"},
        ),
        ("qualisys://h", "qualisys", "z", {"hostname": "h"}),
        ("qualisys://h:22222", "qualisys", "z", {"hostname": "h", "port": "22222"}),
        ("vrpn://h", "vrpn", "z", {"hostname": "h"}),
        ("vrpn://h:3884", "vrpn", "z", {"hostname": "h:3884"}),
    ],
)
def test_addresses(address: str, kind: str, up: str, configuration: dict[str, str]) -> None:
    system = parse_system(address)
    assert (system.kind, system.up, system.configuration) == (kind, up, configuration)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("host", "not a motion capture system"),
        ("vicon:host", "not a motion capture system"),
        ("vicon://", "has no host"),
        ("vikon://h", "did you mean 'vicon'"),
        ("vicon://h?latncy=1", "did you mean 'latency'"),
        ("vicon://h?latency=nan", "latency is 'nan'"),
        ("vicon://h?latency=soon", "latency is 'soon'"),
        ("optitrack://h?port=x", "port is 'x'"),
        ("optitrack://h?up=x", "up is 'x'"),
        ("vicon://h?port=1510", "for optitrack:// only"),
        ("vicon://h:90000", "port must be a whole number"),
        ("optitrack://h:1510", r"an option, \?port=1510"),
        ("sim://alpha", "takes neither host"),
        (3, "not a motion capture system"),
    ],
)
def test_errors_about_addresses_show_the_right_form(address: str, said: str) -> None:
    with pytest.raises((UsageError, UnknownNameError), match=said):
        parse_system(address)


def test_y_up_becomes_z_up_and_upright_bodies_stay_upright() -> None:
    position, quaternion = z_up((1.0, 2.0, 3.0), UPRIGHT)
    assert position == (1.0, -3.0, 2.0)
    assert quaternion == UPRIGHT
    about_y = (0.0, math.sin(0.3), 0.0, math.cos(0.3))  # turned by 0.6 rad about the former up axis
    pose = BodyPose("a", 0, *z_up((0.0, 0.0, 0.0), about_y))
    assert pose.yaw_rad == pytest.approx(0.6)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_quaternions_agree_with_scipy(roll: float, pitch: float, yaw: float) -> None:
    ours = quaternion_from_euler(roll, pitch, yaw)
    theirs = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    pose = BodyPose("a", 0, (1.0, 2.0, 3.0), ours)
    assert np.allclose(pose.rotation.as_matrix(), theirs.as_matrix(), atol=1e-9)
    assert np.allclose(pose.transform.translation, pose.position_m)
    assert math.remainder(pose.yaw_rad - yaw, math.tau) == pytest.approx(0.0, abs=1e-6)
    assert plausible(pose.position_m, ours)


@pytest.mark.parametrize(
    ("position", "quaternion"),
    [((math.nan, 0.0, 0.0), UPRIGHT), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0))],
)
def test_implausible_poses(position: Vector, quaternion: Quaternion) -> None:
    assert not plausible(position, quaternion)


def fed(speed: float, count: int = 30, step_ms: int = 10) -> Track:
    rng = np.random.default_rng(3)
    track = Track("a")
    for n in range(1, count + 1):
        x = speed * n * step_ms * 1e-3 + rng.normal(0.0, 0.0002)
        track.add(n * step_ms * MS, (x, 0.0, 1.0), UPRIGHT)
    return track


def test_the_velocity_is_right_in_spite_of_noise() -> None:
    pose = fed(0.7).pose
    assert pose is not None
    assert pose.velocity_m_s is not None
    assert pose.velocity_m_s[0] == pytest.approx(0.7, abs=0.02)
    assert pose.velocity_m_s[2] == pytest.approx(0.0, abs=1e-9)
    few = fed(0.7, count=3).pose
    assert few is not None
    assert few.velocity_m_s is None


def test_an_unseen_body_has_no_pose_and_is_lost_once() -> None:
    track = Track("a")
    assert track.state is TrackState.WAITING
    assert not track.update(10**12), "a body never seen is not lost"
    track = fed(0.1)
    assert track.state == "tracked"
    assert not track.update(499 * MS)
    assert track.update(500 * MS)
    assert track.pose is None
    assert track.state == "lost"
    assert not track.update(900 * MS)
    found = track.add(1000 * MS, (0.0, 0.0, 1.0), UPRIGHT)
    assert found is not None
    assert found.velocity_m_s is None, "no velocity across a gap"
    assert track.add(1000 * MS, (0.1, 0.0, 1.0), UPRIGHT) is None, "not newer"


@pytest.mark.parametrize("may_freeze", [True, False])
def test_an_unchanging_pose_is_not_a_measurement(may_freeze: bool) -> None:
    track = Track("a", may_freeze=may_freeze)
    for n in range(1, 101):
        track.add(n * 10 * MS, (1.0, 2.0, 3.0), UPRIGHT)
        track.update(n * 10 * MS)
    assert (track.pose is not None) is may_freeze
    track.end()
    assert track.state is TrackState.ENDED
    assert track.pose is None


def at_rest(turn: Quaternion, *, noise_m: float = 0.0002, noise_rad: float = 0.001, count: int = 200) -> list[BodyPose]:
    rng = np.random.default_rng(5)
    poses = []
    for n in range(count):
        shake = quaternion_from_euler(*rng.normal(0.0, noise_rad, 3).tolist())
        x, y, z = (np.array([1.0, 2.0, 0.1]) + rng.normal(0.0, noise_m, 3)).tolist()
        sign = 1.0 if n % 2 else -1.0  # both signs are the same rotation
        a, b, c, d = multiply(turn, shake)
        poses.append(BodyPose("a", n, (x, y, z), (sign * a, sign * b, sign * c, sign * d)))
    return poses


@given(angles, st.floats(-1.4, 1.4), angles, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), angles)
def test_a_calibration_finds_the_drones_attitude_whatever_the_bodys_axes(
    a: float, b: float, c: float, roll: float, pitch: float, heading: float
) -> None:
    poses = at_rest(quaternion_from_euler(a, b, c), count=40)
    found = calibrate(poses, roll=roll, pitch=pitch, yaw=heading + 0.5, heading=heading)
    drone = found.apply(poses[0])
    wanted = Rotation.from_quat(quaternion_from_euler(roll, pitch, heading))
    assert (wanted.inv() * drone.rotation).magnitude() < 0.01
    assert found.yaw_offset == pytest.approx(0.5)
    assert found.poses == 40


def test_the_mean_rotation_is_the_middle_one() -> None:
    mean = mean_quaternion([pose.quaternion for pose in at_rest(quaternion_from_euler(0.1, 0.2, 0.3))])
    apart = Rotation.from_quat(mean).inv() * Rotation.from_quat(quaternion_from_euler(0.1, 0.2, 0.3))
    assert apart.magnitude() < 0.0005


@pytest.mark.parametrize(("noise_m", "noise_rad"), [(0.01, 0.001), (0.0002, 0.05)])
def test_a_calibration_in_motion_is_refused_with_its_spread(noise_m: float, noise_rad: float) -> None:
    with pytest.raises(UsageError, match=r"spread by .* mm and .*°.*keep the drone still"):
        calibrate(at_rest(UPRIGHT, noise_m=noise_m, noise_rad=noise_rad))
    with pytest.raises(UsageError, match="at least 20 poses"):
        calibrate(at_rest(UPRIGHT, count=5))


def test_frames_go_through_a_pipe() -> None:
    pipe = io.BytesIO()
    frames = [RawFrame(n, {"a": ((1.0, 2.0, 3.0), UPRIGHT)}) for n in range(3)]
    for frame in frames:
        write(pipe, frame)
    whole = pipe.getvalue()
    pipe.seek(0)
    assert [read(pipe), read(pipe), read(pipe), read(pipe)] == [*frames, None]
    assert read(io.BytesIO(whole[:-1][: len(whole) // 3 - 2])) is None, "cut short"
    with pytest.raises(msgspec.DecodeError):
        read(io.BytesIO(LENGTH.pack(1 << 30)))
    with pytest.raises(msgspec.DecodeError):
        read(io.BytesIO(LENGTH.pack(3) + b"abc"))
