"""An emulated Betaflight racing drone that flies a simulated vehicle and is open to any program using MSP over TCP.

To use it in a test::

    from skyloop.vehicles.msp.emulator import BetaflightFirmware, with_racers
    from skyloop.sim.host import SimHost
    from skyloop.sim.options import SimOptions

    host = SimHost(with_racers(SimOptions(world="room", seed=1)))
    with BetaflightFirmware(host, port=0) as firmware:
        firmware.address  # for a driver: msp://tcp:127.0.0.1:…
        host.simulation.truth(0).position_m  # the vehicle's true position

It uses the simulated vehicle's barometer and GPS. It answers the driver's requests, and is set up as described in
``docs/msp.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.messages.feedback import EarthOrigin
from skyloop.sim.host import Report, SimHost
from skyloop.sim.options import SimOptions
from skyloop.sim.parameters import VehicleParameters
from skyloop.vehicles.emulation.emulator import ByteServer, Emulator, Loop, RunningEmulator
from skyloop.vehicles.emulation.flight import FlightControl, SimulatedVehicle, Vehicle
from skyloop.vehicles.msp.wire import messages as msp
from skyloop.vehicles.msp.wire.firmwares import (
    ARM_SWITCH,
    BETAFLIGHT_FLAGS,
    AxisRates,
    Rates,
    pack_betaflight_rates,
    rate_curve,
    share_of,
)
from skyloop.vehicles.msp.wire.frames import Direction, MspFrame, Parser, encode
from skyloop.vehicles.msp.wire.messages import BETAFLIGHT, USUAL_MAP, Function, ModeRange, OnLoss, RxConfig

__all__ = ["BetaflightFirmware", "BoardSettings", "with_racers"]

PORT: Final = 5761  #: TCP port of the first serial port in Betaflight's SITL
CHANNELS: Final = 18  #: number of receiver channels in Betaflight
HOVER_THROTTLE: Final = 0.32  #: hover throttle as a fraction of full throttle; an estimate
THRUST_POWER: Final = 1.6  #: exponent with which thrust depends on throttle; an estimate
CELLS: Final = 4  #: number of battery cells

#: A 5-inch quadrotor with a four-cell battery. The values are typical estimates.
RACER: Final = VehicleParameters(
    mass_kg=0.6,
    radius_m=0.18,
    half_height_m=0.04,
    rotor_radius_m=0.064,
    rotor_height_m=0.05,
    most_thrust=3.0,
    least_thrust=0.1,
    motor_time_constant_s=0.03,
    battery_full_v=16.8,
    battery_empty_v=13.2,
    battery_charge_c=5400.0,  # 1500 mAh
    hover_power_w=120.0,
)
REPORTS_HZ: Final = 100.0  #: rate at which the simulation reports to the flight controller
_ACTUAL: Final = AxisRates(7, 0, 67)
#: Betaflight's default rates: 70 degrees/s near the centre of a stick, 670 at its end.
USUAL_RATES: Final = Rates("actual", _ACTUAL, _ACTUAL, _ACTUAL)
#: Each mode's permanent number and name, in the order of the status bits, as in Betaflight 4.6 with default features.
BOXES: Final = ((0, "ARM"), (1, "ANGLE"), (2, "HORIZON"), (27, "FAILSAFE"), (28, "AIR MODE"), (36, "PREARM"))
#: Replies of Betaflight 4.6.0 that don't depend on the emulator's state, keyed by number: size in bytes, and the first
#: bytes in hexadecimal; the rest are zeros. They were recorded from Betaflight's SITL at rest, with default settings.
RECORDED: Final[dict[int, tuple[int, str]]] = {
    5: (30, "4e6f76203236203230323631353a30343a323700484f52495a4f1f402b20"),
    10: (0, ""),
    38: (6, ""),
    40: (15, "02060a01900100000650"),
    42: (2, "03"),
    50: (1, ""),
    52: (180, ""),
    54: (
        56,
        "330100050400053400000504000535000005040005360000050400053700000504000538000005040005390000050400"
        "053a000005040005",
    ),
    56: (7, "01050a006e0a01"),
    58: (4, ""),
    70: (13, ""),
    79: (11, ""),
    80: (11, "01000104400002"),
    82: (1, ""),
    90: (20, "01010100e001260200000000307d000000020062"),
    92: (49, "fa4b006400000000000000000000000000000000fa00f4010000960000fa00f4014b0096000000000000000000000005"),
    96: (5, "000101"),
    104: (16, "e803e803e803e803"),
    112: (15, "2d501e2f54222d5000324b4b28"),
    117: (25, "524f4c4c3b50495443483b5941573b4c4556454c3b4d41473b"),
    124: (6, "7e05ea05b405"),
    125: (5, "00000032"),
    126: (19, "00000083"),
    128: (2, "0a"),
    129: (10, "0a0000000050"),
    131: (10, "0000d007e803040e"),
    133: (2, ""),
    139: (53, "04"),
    140: (53, "026464646464646464000000000000000001644b0096004b00960000000000000000000164fa00f401fa00f401"),
    142: (18, "2d501e2878002f54222e7d002d50000078"),
    143: (18, "008f"),
    144: (18, "0090"),
    145: (3, "010101"),
    160: (12, "000000000100000002"),
    187: (2, "04"),
    238: (61, "1400000001"),
    240: (4, "00ef"),
}


#: Write functions with numbers up to 100 that Betaflight 4.6.0 acknowledges even when empty; they have no effect here.
#: The numbers 59, 61, 68 (which restarts the firmware) and 69 are excluded, because they get other replies or none.
EMPTY_WRITES: Final = frozenset(
    (11, 33, 35, 37, 39, 41, 43, 45, 51, 53, 55, 57, 60, 62, 65, 76, 78, 91, 93, 95, 97, 99)
)


@dataclass(frozen=True, slots=True)
class BoardSettings:
    """The flight controller's settings, by default those described in ``docs/msp.md``."""

    ranges: tuple[ModeRange, ...] = (ModeRange(0, 0, 1700, 2100), ModeRange(1, 1, 900, 2100))
    failsafe: msp.FailsafeConfig = field(default_factory=lambda: msp.FailsafeConfig(1.5, 60.0, 1000, 10.0, 1))
    on_loss: tuple[tuple[int, int], ...] = (
        ((OnLoss.AUTO, 1500),) * 3 + ((OnLoss.AUTO, 875),) + ((OnLoss.HOLD, 1500),) * (CHANNELS - 4)
    )
    rates: Rates = USUAL_RATES
    angle_limit_deg: int = 60
    rx_msp: bool = True
    gps: bool = True
    barometer: bool = True
    boot_s: float = 0.5  #: time until arming is possible [s]; 5 s on real flight controllers
    flags: int = 0  #: additional flags that prevent arming, one bit each


USUAL: Final = BoardSettings()


def with_racers(options: SimOptions | None = None) -> SimOptions:
    """Return the options for a world of racers, which have no cameras because MSP does not transmit video."""
    return replace(options or SimOptions(), parameters=RACER, rate_hz=REPORTS_HZ, cameras=())


#: The identity of Betaflight 4.6.0.
API: Final = (1, 47)
VERSION: Final = (4, 6, 0)
NAME: Final = "EMULATED"
FLAGS: Final = len(BETAFLIGHT_FLAGS) + 1  #: number of flags, including ARM_SWITCH
LOSS_NS: Final = nanoseconds(0.15)  #: time without sticks after which the receiver counts as lost
HOLD_NS: Final = nanoseconds(0.3)  #: how long the last sticks remain in force
RECOVERY_NS: Final = nanoseconds(0.5)  #: how long stick frames must arrive before the receiver counts as recovered
IDLE: Final = 0.055  #: fraction of full throttle at which the motors idle while armed
LEVEL_RAD: Final = math.radians(25.0)  #: maximum tilt at which arming is possible
GROUND_M: Final = 0.06  #: height below which a vehicle with low thrust counts as on the ground
ORIGIN: Final = EarthOrigin(47.0, 8.0, 400.0, 6_371_000.0)  #: arbitrary position of the world's origin on Earth
SATELLITES: Final = 14  #: reported number of satellites, enough for a fix
_ROLL, _PITCH, _YAW, _THROTTLE = range(4)


def bit(name: str) -> int:
    """Return the bit for a flag that prevents arming."""
    return 1 << (FLAGS - 1 if name == ARM_SWITCH else BETAFLIGHT_FLAGS.index(name))


class EmulatedBoard:
    """One flight controller. Not thread-safe: use it only on the loop's thread.

    ``received`` holds the latest sticks in the order roll, pitch, yaw, throttle, AUX; ``frames`` counts stick frames.
    """

    def __init__(self, vehicle: Vehicle, settings: BoardSettings, now_ns: int) -> None:
        self.settings = settings
        self.armed = False
        self.received: list[int] = []
        self.frames = 0
        self.silenced = False  #: whether it sends no replies, as if the line were cut
        self._flight = FlightControl(vehicle)
        self._report: Report | None = None
        self._begun_ns = now_ns
        self._came_ns: int | None = None
        self._good_since_ns = now_ns
        self._failsafe = False
        self._landing_ns: int | None = None
        self._not_disarmed = False
        self._had_sticks = False
        self._refused = False  # whether the arm switch was on while something prevented arming
        self._crashed = False
        self._ground_m = 0.0
        self._data = [1500, 1500, 1500, 885, *[1500] * (CHANNELS - 4)]  # the sticks in force
        tilt = share_of(rate_curve(settings.rates.kind, settings.rates.roll))
        self._tilt: Callable[[float], float] = lambda stick: math.radians(settings.angle_limit_deg) * tilt(stick)
        self._turn = rate_curve(settings.rates.kind, settings.rates.yaw)

    # Frames --------------------------------------------------------------------------------------------------------

    def answer(self, frame: MspFrame, now_ns: int) -> MspFrame | None:
        """Handle a frame and return the reply."""
        if frame.direction is not Direction.REQUEST or self.silenced:
            return None
        payload = self._payload(frame, now_ns)
        if payload is None:
            return MspFrame(frame.function, b"", Direction.ERROR)
        return MspFrame(frame.function, payload, Direction.REPLY)

    def _payload(self, frame: MspFrame, now_ns: int) -> bytes | None:
        if frame.function == Function.SET_RAW_RC:
            return self._take_sticks(msp.channels(frame.payload), now_ns)
        if frame.function == Function.MULTIPLE:
            made = b""
            for function in frame.payload:
                part = self._state(function, now_ns) or b""
                made += bytes((len(part),)) + part
            return made
        if frame.function in EMPTY_WRITES and not frame.payload:
            return b""
        return self._state(frame.function, now_ns)

    def _take_sticks(self, widths: list[int], now_ns: int) -> bytes | None:
        if len(widths) > CHANNELS or len(widths) < len(USUAL_MAP):
            return None
        places = [*USUAL_MAP, *range(4, len(widths))]
        self.received = [widths[place] for place in places]
        self.frames += 1
        if self._came_ns is None or now_ns - self._came_ns >= LOSS_NS:
            self._good_since_ns = now_ns
        self._came_ns = now_ns
        return b""

    def _state(self, function: int, now_ns: int) -> bytes | None:
        settings = self.settings
        if function == Function.RAW_GPS and not settings.gps:
            return None
        makers: dict[int, Callable[[], bytes]] = {
            Function.API_VERSION: lambda: bytes((0, *API)),
            Function.FC_VARIANT: BETAFLIGHT.encode,
            Function.FC_VERSION: lambda: bytes(VERSION),
            Function.BOARD_INFO: lambda: b"SKYL\0\0\0\0" + bytes((len(NAME),)) + NAME.encode(),
            Function.BOXIDS: lambda: bytes(number for number, _ in BOXES),
            Function.BOXNAMES: lambda: "".join(f"{name};" for _, name in BOXES).encode(),
            Function.MODE_RANGES: lambda: msp.pack_mode_ranges(settings.ranges),
            Function.RX_MAP: lambda: bytes((*USUAL_MAP, 4, 5, 6, 7)),
            Function.RX_CONFIG: RxConfig().encode,
            Function.FAILSAFE_CONFIG: settings.failsafe.encode,
            Function.RXFAIL_CONFIG: lambda: msp.pack_rx_fail(settings.on_loss),
            Function.RC_TUNING: lambda: pack_betaflight_rates(settings.rates),
            Function.PID_ADVANCED: lambda: bytes(msp.ANGLE_LIMIT_AT) + bytes((settings.angle_limit_deg,)) + bytes(43),
            Function.FEATURE_CONFIG: lambda: (msp.RX_MSP * settings.rx_msp).to_bytes(4, "little"),
            Function.BATTERY_CONFIG: lambda: bytes((33, 43)),
            Function.STATUS: lambda: self._status(now_ns).betaflight(),
            Function.STATUS_EX: lambda: self._status(now_ns).betaflight(),
            Function.RC: lambda: msp.pack_channels(self._data),
            Function.ATTITUDE: lambda: self._attitude().encode(),
            Function.ALTITUDE: lambda: self._altitude().encode(),
            Function.RAW_GPS: lambda: self._gps().encode(),
            Function.RAW_IMU: lambda: self._imu().encode(),
            Function.BATTERY_STATE: lambda: self._battery().state(),
            Function.ANALOG: lambda: self._battery().analog(),
        }
        if function in makers:
            return makers[function]()
        if function not in RECORDED:
            return None
        length, begin = RECORDED[function]
        return bytes.fromhex(begin).ljust(length, b"\0")

    # State ---------------------------------------------------------------------------------------------------------

    def _status(self, now_ns: int) -> msp.MspStatus:
        settings = self.settings
        has = msp.Sensor
        sensors = 1 << has.ACCELEROMETER | settings.barometer << has.BAROMETER | settings.gps << has.GPS
        modes = sum(1 << place for place, (number, _) in enumerate(BOXES) if number and self._is_on(number))
        return msp.MspStatus(sensors, modes | self.armed, self._hindrances(now_ns), FLAGS, 125, 12)

    def _attitude(self) -> msp.MspAttitude:
        believed = self._seen.believed
        heading = 90.0 - math.degrees(believed.yaw_rad)
        return msp.MspAttitude(math.degrees(believed.roll_rad), math.degrees(believed.pitch_rad), heading)

    def _altitude(self) -> msp.Altitude:
        believed = self._seen.believed
        return msp.Altitude(believed.altitude_m - self._ground_m, believed.velocity_m_s[2])

    def _gps(self) -> msp.Gps:
        truth = self._seen.truth
        latitude, longitude, altitude = ORIGIN.place_of(truth.position_m)
        east, north, _ = truth.velocity_m_s
        course = math.degrees(math.atan2(east, north)) % 360
        return msp.Gps(True, SATELLITES, latitude, longitude, altitude, math.hypot(east, north), course)

    def _imu(self) -> msp.Imu:
        believed = self._seen.believed
        roll, pitch, yaw = (round(math.degrees(rate)) for rate in believed.angular_velocity_rad_s)
        x, y, z = (round(part / 9.80665 * 512) for part in believed.acceleration_m_s2)
        return msp.Imu((x, y, z), (roll, pitch, yaw), (0, 0, 0))

    def _battery(self) -> msp.Battery:
        return msp.Battery(self._seen.believed.battery_v, 0.0, CELLS)

    @property
    def _seen(self) -> Report:
        assert self._report is not None
        return self._report

    def _is_on(self, number: int) -> bool:
        """Return whether a switch is in the range that activates the mode with this permanent number."""
        ranges = [each for each in self.settings.ranges if each.mode == number]
        return any(each.low_us <= self._data[4 + each.aux] < each.high_us for each in ranges)

    def _hindrances(self, now_ns: int) -> int:
        believed = self._seen.believed
        if self.armed:
            return 0 if self._gets_sticks(now_ns) else bit("RXLOSS")
        recovered = self._gets_sticks(now_ns) and now_ns - self._good_since_ns >= RECOVERY_NS
        tilted = max(abs(believed.roll_rad), abs(believed.pitch_rad)) > LEVEL_RAD
        conditions = {
            "RXLOSS": not recovered,
            "FAILSAFE": self._failsafe,
            "NOT_DISARMED": self._not_disarmed,
            "CRASH": self._crashed,
            "THROTTLE": self._data[_THROTTLE] > RxConfig().low_us,
            "ANGLE": tilted,
            "BOOTGRACE": now_ns - self._begun_ns < nanoseconds(self.settings.boot_s),
            ARM_SWITCH: self._refused,
        }
        return sum(bit(name) for name, on in conditions.items() if on) | self.settings.flags

    def _gets_sticks(self, now_ns: int) -> bool:
        return self._came_ns is not None and now_ns - self._came_ns < LOSS_NS

    # Time ----------------------------------------------------------------------------------------------------------

    def crashed(self) -> None:
        """Disarm because the vehicle hit something hard."""
        self.armed, self._crashed = False, True

    def tick(self, report: Report, now_ns: int) -> None:
        """Handle the vehicle's newest report and update receiver, failsafe, switches and motors. Called regularly."""
        self._report = report
        self._flight.update(report)
        if not self.armed and self._flight.standing:
            self._ground_m = report.believed.altitude_m
        self._receive(now_ns)
        self._switch(now_ns)
        self._fly()

    def _receive(self, now_ns: int) -> None:
        came_ns = self._came_ns
        silent_ns = None if came_ns is None else now_ns - came_ns
        if silent_ns is None:
            return
        if silent_ns < LOSS_NS:
            if self._failsafe and now_ns - self._good_since_ns >= RECOVERY_NS:
                self._failsafe, self._landing_ns = False, None
            if not self._failsafe:
                self._data[: len(self.received)] = self.received
        elif silent_ns >= HOLD_NS:
            self._lose_sticks()
        if self.armed and silent_ns >= nanoseconds(self.settings.failsafe.delay_s):
            self._fail(now_ns)

    def _lose_sticks(self) -> None:
        usual = (1500, 1500, 1500, RxConfig().least_us)
        for channel, (mode, width) in enumerate(self.settings.on_loss):
            if mode == OnLoss.SET:
                self._data[channel] = width
            elif mode == OnLoss.AUTO:
                self._data[channel] = usual[channel] if channel < len(usual) else 1500

    def _fail(self, now_ns: int) -> None:
        """Execute the failsafe after sticks have stopped arriving: land or drop."""
        config = self.settings.failsafe
        if self._landing_ns is None:
            self._landing_ns = now_ns
        self._failsafe = True
        self._data[:4] = [1500, 1500, 1500, config.throttle_us]
        if config.procedure != 0 or now_ns - self._landing_ns >= nanoseconds(config.landing_s):
            self.armed = False

    def _switch(self, now_ns: int) -> None:
        on, gets = self._is_on(0), self._gets_sticks(now_ns)
        if gets and not self._had_sticks and on and not self.armed:
            self._not_disarmed = True
        self._had_sticks = gets
        if not on:
            if gets:
                self.armed = self._not_disarmed = self._refused = self._crashed = False
            return
        if not self.armed and not self._refused:
            if self._hindrances(now_ns):
                self._refused = True
            else:
                self.armed = True

    def _fly(self) -> None:
        flight = self._flight
        if not self.armed:
            if flight.state.airborne:
                flight.cut()
            else:
                flight.lie()
            return
        throttle = max(IDLE, min(1.0, (self._data[_THROTTLE] - 1000) / 1000))
        thrust = (throttle / HOVER_THROTTLE) ** THRUST_POWER
        if flight.standing:
            if thrust > 1.02:
                flight.lift_off()
            return
        if flight.place[2] < GROUND_M and thrust < 0.97:
            flight.land()
        if not flight.airborne:
            return
        roll, pitch, yaw = ((self._data[axis] - 1500) / 500 for axis in (_ROLL, _PITCH, _YAW))
        turn = -math.copysign(math.radians(self._turn(abs(yaw))), yaw)
        flight.lean_by_thrust(self._lean(roll), self._lean(pitch), thrust, turn)

    def _lean(self, stick: float) -> float:
        """Return the angle that a stick commands in ANGLE mode; level in other modes, which are not emulated."""
        return math.copysign(self._tilt(min(1.0, abs(stick))), stick) if self._is_on(1) else 0.0


# The firmware --------------------------------------------------------------------------------------------------------


class RunningFirmware(RunningEmulator):
    """A flight controller that is switched on. Use it only on the loop's thread."""

    def __init__(
        self, host: SimHost, drone: int, bind: str, port: int, settings: BoardSettings, loop: Loop | None
    ) -> None:
        super().__init__(host, drone, loop or "skyloop-betaflight")
        self.board = EmulatedBoard(SimulatedVehicle(host.simulation, drone), settings, monotonic_ns())
        self._parser = Parser()
        simulation = host.simulation
        first = Report(simulation.feedback(drone), simulation.truth(drone), (), monotonic_ns())
        self.board.tick(first, monotonic_ns())
        try:
            self._server = ByteServer(self._loop, (bind, port), self._receive, self._parser.reset, name="MSP")
            self._open.append(self._server)
            if self._own_loop:
                self._loop.start()
            host.attach(drone, self, self, [])
        except BaseException:
            self.stop()
            raise

    @property
    def port(self) -> int:
        return self._server.port

    def _receive(self, data: bytes) -> None:
        now_ns = monotonic_ns()
        for frame in self._parser.feed(data):
            reply = self.board.answer(frame, now_ns)
            if reply is not None:
                self._server.send(encode(reply))

    def _tick(self, report: Report) -> None:
        self.board.tick(report, monotonic_ns())

    def _crashed(self, text: str) -> None:  # noqa: ARG002  the reason does not matter here
        self.board.crashed()


class BetaflightFirmware(Emulator[RunningFirmware]):
    """The flight controller of one drone in a host's world. Several may share a host, each with its own drone and port.

    Create the host with options from :func:`with_racers`.

    Args:
        host: The simulated world.
        drone: Number of the drone in that world.
        bind: The local address to listen on.
        port: The TCP port; 0 for any free one.
        settings: The flight controller's settings.
        loop: Thread shared by a fleet; None for a separate thread.
    """

    def __init__(
        self,
        host: SimHost,
        drone: int = 0,
        *,
        bind: str = "127.0.0.1",
        port: int = PORT,
        settings: BoardSettings = USUAL,
        loop: Loop | None = None,
    ) -> None:
        super().__init__(host, drone)
        self.settings = settings
        self._bind, self._port = bind, port
        self._loop = loop

    def _switched_on(self) -> RunningFirmware:
        running = RunningFirmware(self.host, self.drone, self._bind, self._port, self.settings, self._loop)
        self._port = running.port  # keeps the port reserved for a restart
        return running

    @property
    def port(self) -> int:
        """The actual port; if 0 was requested, the system chose it."""
        return self._started.port

    @property
    def board(self) -> EmulatedBoard:
        """The running flight controller, for tests. Use it only on the loop's thread."""
        return self._started.board

    @property
    def address(self) -> str:
        """Address for a driver on this machine."""
        return f"msp://tcp:{self._bind}:{self.port}"

    @property
    def description(self) -> str:
        """A readable one-line summary: kind, number and address."""
        return f"betaflight drone {self.drone}: {self.address}"
