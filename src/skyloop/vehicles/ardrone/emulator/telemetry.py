"""Navdata options made from the vehicle's own estimate, in the drone's units, axes and signs. Pure.

The drone's body axes are x forward, y right, z down; theta is positive nose up, psi positive clockwise. Values that the
simulation does not provide are zero: tags seen by the drone's own vision, optical flow, trackers, internal values of
the barometer and of vision, and GPS (no receiver is plugged in).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.messages import FlightState
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.sim.reports import VehicleFeedback
from skyloop.vehicles.ardrone.emulator.flight import NO_PROGRESS, ProgressCommand
from skyloop.vehicles.ardrone.wire import navdata as o
from skyloop.vehicles.ardrone.wire.configuration import NAVDATA_OPTIONS_USUAL, VideoChannel
from skyloop.vehicles.ardrone.wire.navdata import ControlState
from skyloop.vehicles.emulation.video import NOTHING_SENT, VideoStatus

STANDARD_PRESSURE_PA: Final = 101_325  #: at the ground: international standard atmosphere at sea level
PRESSURE_PA_PER_M: Final = 12.0  #: decrease in pressure per metre near the ground, in the same atmosphere
TEMPERATURE_DECI_C: Final = 250  #: chosen: 25 °C
FIELD_MG: Final = (200.0, 400.0)  #: horizontal and downward components of the Earth's field at middle latitudes
LAST_TAG_1: Final = 19  #: highest tag that an AR.Drone 1 sends: VIDEO_STREAM

_CONTROL_STATES: Final = {
    FlightState.LANDED: ControlState.LANDED,
    FlightState.TAKING_OFF: ControlState.TAKING_OFF,
    FlightState.HOVERING: ControlState.HOVERING,
    FlightState.FLYING: ControlState.FLYING,
    FlightState.LANDING: ControlState.LANDING,
    FlightState.EMERGENCY: ControlState.DEFAULT,
}


@dataclass(frozen=True, slots=True)
class ArdroneSnapshot:
    """The inputs from which all options are made."""

    believed: VehicleFeedback
    state: FlightState
    time: int  #: see :meth:`skyloop.vehicles.ardrone.emulator.video.DroneClock.navdata_time`
    thrust: float = 0.0  #: multiple of the weight
    most_thrust: float = 1.9
    trim_rad: tuple[float, float] = (0.0, 0.0)  #: roll and pitch that are reported as level
    progress: ProgressCommand = NO_PROGRESS
    flipping: bool = False
    video: VideoStatus = NOTHING_SENT
    channel: VideoChannel = VideoChannel.FRONT
    link_quality: int = 100

    @property
    def theta_mdeg(self) -> float:
        """Pitch, positive nose up, relative to the trim [0.001°]."""
        return -math.degrees(self.believed.pitch_rad - self.trim_rad[1]) * 1000

    @property
    def phi_mdeg(self) -> float:
        """Roll, positive right side down, relative to the trim [0.001°]."""
        return math.degrees(self.believed.roll_rad - self.trim_rad[0]) * 1000

    @property
    def psi_mdeg(self) -> float:
        """Yaw, positive clockwise [0.001°]."""
        return -math.degrees(self.believed.yaw_rad) * 1000

    @property
    def heading_deg(self) -> float:
        """Heading, positive clockwise from north, from -180 to 180."""
        return (90.0 - math.degrees(self.believed.yaw_rad) + 180.0) % 360.0 - 180.0

    @property
    def velocity_mm_s(self) -> tuple[float, float, float]:
        """Velocity forward, right, down, in the levelled axes."""
        forward, left, up = self.believed.velocity_m_s
        return forward * 1000, -left * 1000, -up * 1000

    @property
    def altitude_mm(self) -> float:
        """Height above the ground."""
        return self.believed.altitude_m * 1000


def options_of(snapshot: ArdroneSnapshot, tags: list[int]) -> list[o.Option]:
    """Return the options with these tags, in the order of the tags given."""
    return [_MAKERS[tag](snapshot) for tag in tags]


def tags_of(mask: int, *, demo: bool, version: int) -> list[int]:
    """Return the tags of the options to send, in ascending order, for the mask ``general:navdata_options``.

    In demo mode, these are the tags in the default and the configured mask. In full mode, these are the tags in the
    configured mask, or all tags if that is the default mask: real drones send all options to clients that never set it.
    """
    if demo:
        mask |= NAVDATA_OPTIONS_USUAL
    elif mask == NAVDATA_OPTIONS_USUAL:
        mask = ~0
    last = LAST_TAG_1 if version == 1 else max(_MAKERS)
    return [tag for tag in range(last + 1) if mask >> tag & 1]


def _demo(s: ArdroneSnapshot) -> o.Option:
    vx, vy, _ = s.velocity_mm_s  # real drones always report vz as 0
    state = ControlState.LOOPING if s.flipping and s.state.airborne else _CONTROL_STATES[s.state]
    return o.Demo(
        ctrl_state=state << 16,
        battery=round(s.believed.battery * 100),
        theta=s.theta_mdeg,
        phi=s.phi_mdeg,
        psi=s.psi_mdeg,
        altitude=max(0, round(s.altitude_mm)),
        vx=vx,
        vy=vy,
        num_frames=s.video.pictures & 0xFFFFFFFF,
        detection_camera_type=int(s.channel),
    )


def _accelerations_mg(s: ArdroneSnapshot) -> tuple[float, float, float]:
    x, y, z = s.believed.acceleration_m_s2
    return x / GRAVITY_M_S2 * 1000, -y / GRAVITY_M_S2 * 1000, -z / GRAVITY_M_S2 * 1000


def _rates_deg_s(s: ArdroneSnapshot) -> tuple[float, float, float]:
    x, y, z = s.believed.angular_velocity_rad_s
    return math.degrees(x), -math.degrees(y), -math.degrees(z)


def _raw(s: ArdroneSnapshot) -> o.Option:
    """Return the raw measurements. The converters' scales are estimates, but programs read the battery voltage here."""
    return o.RawMeasures(
        accs=tuple(_within(2048 + mg * 0.512, 0, 4095) for mg in _accelerations_mg(s)),
        gyros=tuple(_within(rate * 16.4, -32768, 32767) for rate in _rates_deg_s(s)),
        gyros_110=tuple(_within(rate * 64, -32768, 32767) for rate in _rates_deg_s(s)[:2]),
        vbat=_within(s.believed.battery_v * 1000, 0, 0xFFFFFFFF),
        us_distance_echo=_within(s.altitude_mm / 10, 0, 65535),
    )


def _physical(s: ArdroneSnapshot) -> o.Option:
    return o.PhysMeasures(acc_temp=45.0, gyro_temp=0, accs=_accelerations_mg(s), gyros=_rates_deg_s(s), alim_3v3=3300)


def _euler_angles(s: ArdroneSnapshot) -> o.Option:
    """Return the attitude computed from the accelerometers alone, which is correct only without acceleration."""
    x, y, z = s.believed.acceleration_m_s2
    theta = math.degrees(math.atan2(x, math.hypot(y, z)))
    return o.EulerAngles(theta * 1000, -math.degrees(math.atan2(y, abs(z))) * 1000)


def _rc_references(s: ArdroneSnapshot) -> o.Option:
    pitch, roll, yaw, gaz = (
        _within(value * 1000, -32768, 32767)
        for value in (s.progress.pitch, s.progress.roll, s.progress.yaw, s.progress.gaz)
    )
    return o.RcReferences(pitch, roll, yaw, gaz, s.progress.flags & 1)


def _pwm(s: ArdroneSnapshot) -> o.Option:
    """Return motor values proportional to thrust, the same for all motors."""
    motor = _within(255 * s.thrust / s.most_thrust, 0, 255)
    return o.Pwm(motors=(motor,) * 4, saturations=(255 if motor else 0,) * 4, vz_ref=s.progress.gaz)


def _altitude(s: ArdroneSnapshot) -> o.Option:
    mm = s.altitude_mm
    return o.Altitude(
        vision=round(mm),
        vz=-s.velocity_mm_s[2],
        reference=round(mm),
        raw=round(mm),
        obs_acc_z=s.believed.acceleration_m_s2[2],
        obs_altitude=mm / 1000,
    )


def _vision(s: ArdroneSnapshot) -> o.Option:
    return o.Vision(
        theta_capture=math.radians(s.theta_mdeg / 1000),
        phi_capture=math.radians(s.phi_mdeg / 1000),
        psi_capture=math.radians(s.psi_mdeg / 1000),
        altitude_capture=round(s.altitude_mm),
        time_capture=s.time & 0x7FFFFFFF,
        body_velocity=s.velocity_mm_s,
    )


def _video_stream(s: ArdroneSnapshot) -> o.Option:
    return o.VideoStream(
        frame_size=s.video.bytes_last & 0xFFFFFFFF,
        frame_number=s.video.pictures & 0xFFFFFFFF,
        out_bitrate=s.video.bitrate_kbps,
        desired_bitrate=s.video.bitrate_kbps,
    )


def _pressure_raw(s: ArdroneSnapshot) -> o.Option:
    pressure = STANDARD_PRESSURE_PA - PRESSURE_PA_PER_M * s.believed.altitude_m
    return o.PressureRaw(temperature=TEMPERATURE_DECI_C, pressure=round(pressure))


def _magneto(s: ArdroneSnapshot) -> o.Option:
    heading = math.radians(s.heading_deg)
    level, down = FIELD_MG
    field = (level * math.cos(heading), -level * math.sin(heading), down)
    mx, my, mz = (_within(each, -32768, 32767) for each in field)
    return o.Magneto(
        *(mx, my, mz),
        raw=field,
        rectified=field,
        heading=s.heading_deg,
        heading_gyro=s.heading_deg,
        heading_fusion=s.heading_deg,
        calibrated=1,
        radius=math.hypot(level, down),
    )


def _zero(kind: Callable[[], o.Option]) -> Callable[[ArdroneSnapshot], o.Option]:
    option = kind()
    return lambda _: option


#: Functions that make the options, keyed by tag. Options without any values to report are all zero, and 27 is ``Gps``.
_MAKERS: Final[dict[int, Callable[[ArdroneSnapshot], o.Option]]] = {
    **{layout.tag: _zero(kind) for kind, layout in o.LAYOUTS.items()},
    0: _demo,
    1: lambda s: o.Time(s.time),
    2: _raw,
    3: _physical,
    5: _euler_angles,
    6: lambda s: o.References(ui_theta=s.progress.pitch, ui_phi=s.progress.roll, ui_psi=s.progress.yaw),
    7: lambda s: o.Trims(0.0, -s.trim_rad[1], s.trim_rad[0]),
    8: _rc_references,
    9: _pwm,
    10: _altitude,
    13: _vision,
    19: _video_stream,
    21: _pressure_raw,
    22: _magneto,
    24: lambda s: o.KalmanPressure(est_z=s.altitude_mm, est_zdot=-s.velocity_mm_s[2]),
    26: lambda s: o.Wifi(s.link_quality),
}


def _within(value: float, low: int, high: int) -> int:
    return max(low, min(high, round(value)))
