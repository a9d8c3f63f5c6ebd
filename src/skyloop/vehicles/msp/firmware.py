"""A flight controller's setup: its switches, its sticks, and whether it may be flown over MSP. Pure.

:class:`Identification` reads the setup, request by request.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final

from skyloop.errors import DecodeError
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.msp.telemetry import Questions
from skyloop.vehicles.msp.wire import messages as msp
from skyloop.vehicles.msp.wire.firmwares import (
    ANGLE,
    ARM,
    MSP_OVERRIDE,
    PREARM,
    Curve,
    Rates,
    betaflight_rates,
    inav_curve,
    rate_curve,
    share_of,
)
from skyloop.vehicles.msp.wire.messages import BETAFLIGHT, INAV, USUAL_MAP, Function, ModeRange, MspIdentity

SUPPORTED: Final = (BETAFLIGHT, INAV)
LEAST_AUX: Final = 4  #: number of AUX channels that are always sent in addition to the sticks
MOST_AUX: Final = 14  #: number of AUX channels that SET_RAW_RC can hold
USUAL_AUX_US: Final = 1000  #: pulse width of an AUX channel that no mode uses
_ARM_NUMBER: Final = 0  #: permanent number of the ARM mode in Betaflight and INAV
LONG_DELAY_S: Final = 2.0  #: delay of a failsafe above which a warning is given
CURVED_API: Final = (1, 46)  #: API version (Betaflight 4.5) from which a stick's tilt follows its rate curve
_PROCEDURES: Final = {
    BETAFLIGHT: ("it lands with failsafe_throttle", "it drops", "it returns by GPS rescue"),
    INAV: ("it lands", "it drops", "it returns home", "it does nothing"),
}
_NOTHING: Final = 3  # INAV's procedure that does nothing
_DOCS: Final = 'see docs/msp.md, "What to set"'


@dataclass(frozen=True, slots=True)
class MspSetup:
    """A flight controller's settings; a setting that was not reported is None."""

    identity: MspIdentity = field(default_factory=MspIdentity)
    boxes: tuple[tuple[int, str], ...] = ()  #: permanent number and name of each mode, in the order of the status bits
    ranges: tuple[ModeRange, ...] = ()
    sticks: tuple[int, ...] = USUAL_MAP  #: positions of roll, pitch, yaw and throttle
    sticks_known: bool = False  #: whether those positions were reported rather than assumed
    rx: msp.RxConfig = field(default_factory=msp.RxConfig)
    failsafe: msp.FailsafeConfig | None = None
    on_loss: tuple[tuple[int, int], ...] = ()  #: each channel's :class:`OnLoss` value and pulse width [µs]
    features: int | None = None
    rates: Rates | None = None
    inav_yaw_rate_deg_s: float | None = None
    inav_expo: tuple[int, int] = (0, 0)  #: INAV's expo for roll and pitch, and for yaw
    angle_limit_deg: float | None = None
    cells: msp.CellVoltages = field(default_factory=msp.CellVoltages)
    receiver_is_msp: bool | None = None  #: whether MSP is the receiver; reported only by INAV

    # Modes -------------------------------------------------------------------------------------------------------

    def number(self, name: str) -> int | None:
        """Return a mode's permanent number; None if the firmware does not have it."""
        return next((number for number, known in self.boxes if known == name), None)

    def mode_names(self, active: int) -> list[str]:
        """Return the names of the modes whose bit is set."""
        return [name for bit, (_, name) in enumerate(self.boxes) if active >> bit & 1]

    def is_active(self, active: int, *names: str) -> bool:
        """Return whether any of these modes is active."""
        return any(name in names for name in self.mode_names(active))

    def ranges_of(self, *names: str) -> list[ModeRange]:
        """Return the ranges that activate these modes."""
        numbers = {self.number(name) for name in names}
        return [each for each in self.ranges if each.mode in numbers]

    @property
    def arm_number(self) -> int | None:
        """The permanent number of the arming mode; if mode names are unknown, the number used in every version."""
        return self.number(ARM) if any(name for _, name in self.boxes) else _ARM_NUMBER

    @property
    def arm_ranges(self) -> list[ModeRange]:
        """The ranges that arm the vehicle."""
        return [each for each in self.ranges if each.mode == self.arm_number]

    @property
    def aux_channels(self) -> int:
        """The number of AUX channels to send; the firmware would choose its own value for any missing channel."""
        used = max((each.aux + 1 for each in self.ranges), default=0)
        return min(MOST_AUX, max(LEAST_AUX, used))

    def aux_us(self, *, arm: bool, given: Mapping[int, int]) -> list[int]:
        """Return AUX channels [µs] that activate the required modes and as few others as possible.

        ``given`` contains the channels set by the user, counted from 0, except for the arm switch.
        """
        wanted = {self.number(ANGLE)}
        if arm:
            wanted |= {self.arm_number, self.number(PREARM)}
        switch = {each.aux for each in self.arm_ranges}
        chosen = []
        for aux in range(self.aux_channels):
            if aux in given and aux not in switch:
                chosen.append(given[aux])
            else:
                chosen.append(self._best(aux, wanted))
        return chosen

    def _best(self, aux: int, wanted: set[int | None]) -> int:
        ranges = [each for each in self.ranges if each.aux == aux]
        edges = sorted({1000, 2000, *(edge for each in ranges for edge in (each.low_us, each.high_us))})
        edges = [edge for edge in edges if 1000 <= edge <= 2000]
        candidates = [USUAL_AUX_US, 2000, *((low + high) // 2 for low, high in pairwise(edges))]
        arm = self.arm_number

        def cost(width: int) -> tuple[int, int, int, int]:
            on = {each.mode for each in ranges if each.low_us <= width < each.high_us}
            asked = {each.mode for each in ranges} & wanted
            # Priorities: first the arm switch, then the required modes, then avoiding other modes.
            return (
                int((arm in on) is not (arm in asked)),
                len(asked - on),
                len(on - wanted),
                0 if width == USUAL_AUX_US else 1,
            )

        return min(candidates, key=cost)

    # Sticks ------------------------------------------------------------------------------------------------------

    @property
    def full_tilt_rad(self) -> float | None:
        """Return the tilt at full stick; None if unknown."""
        return None if self.angle_limit_deg is None else math.radians(self.angle_limit_deg)

    def tilt_curves(self) -> tuple[Curve, Curve]:
        """Return the curves from the roll and pitch sticks to a fraction of the full tilt."""
        if self.identity.variant == INAV:
            curve = inav_curve(self.inav_expo[0], 1.0)
            return curve, curve
        if self.rates is None or self.identity.api < CURVED_API:
            return _straight, _straight
        kind = self.rates.kind
        return share_of(rate_curve(kind, self.rates.roll)), share_of(rate_curve(kind, self.rates.pitch))

    def yaw_curve(self) -> Curve:
        """Return the curve from the stick to the yaw rate [rad/s]."""
        if self.identity.variant == INAV:
            return inav_curve(self.inav_expo[1], math.radians(self.inav_yaw_rate_deg_s or 200.0))
        if self.rates is None:
            return lambda stick: math.radians(200.0) * stick
        curve = rate_curve(self.rates.kind, self.rates.yaw)
        return lambda stick: math.radians(curve(stick))

    # Fitness for flight ------------------------------------------------------------------------------------------

    def diagnose(self, *, override: bool) -> list[Diagnostic]:
        """Return diagnostics about what the settings mean for a flight. Severe diagnostics prevent arming."""
        name = Diagnostic("firmware", True, str(self.identity))
        return [name, *self._modes(override), *self._receiver(override), *self._failsafe(override)]

    def _modes(self, override: bool) -> list[Diagnostic]:
        found = []
        if not override:
            armed = bool(self.ranges_of(ARM))
            detail = "an AUX channel arms it" if armed else "no AUX channel arms it"
            advice = "" if armed else "aux 0 0 0 1700 2100 0 0 (ARM on AUX 1)"
            found.append(Diagnostic("arm switch", armed, detail, advice, severe=True))
        level = bool(self.ranges_of(ANGLE))
        detail = "an AUX channel switches ANGLE mode on" if level else "no AUX channel switches ANGLE mode on"
        advice = "" if level else "aux 1 1 1 900 2100 0 0 (ANGLE always, by AUX 2)"
        found.append(Diagnostic("ANGLE mode", level, detail, advice, severe=True))
        if override:
            there = bool(self.ranges_of(*MSP_OVERRIDE))
            detail = "a receiver switch hands over the sticks" if there else "no switch hands over the sticks"
            advice = "" if there else "assign the mode MSP OVERRIDE to a receiver switch"
            found.append(Diagnostic("MSP override", there, detail, advice, severe=True))
        return found

    def _receiver(self, override: bool) -> list[Diagnostic]:
        is_msp = self.receiver_is_msp
        if self.identity.variant == BETAFLIGHT and self.features is not None:
            is_msp = bool(self.features & msp.RX_MSP)
        if is_msp is None:
            return []
        if override:
            detail = "its receiver is MSP, not a pilot's" if is_msp else "a pilot's receiver is connected"
            advice = "leave override= out of the address, or connect a receiver" if is_msp else ""
            return [Diagnostic("receiver", not is_msp, detail, advice, severe=True)]
        detail = "sticks arrive by MSP" if is_msp else "sticks do not arrive by MSP"
        advice = "feature RX_MSP (INAV: set receiver_type = MSP), or override=1 with a pilot's receiver"
        return [Diagnostic("receiver", is_msp, detail, "" if is_msp else advice, severe=True)]

    def _failsafe(self, override: bool) -> list[Diagnostic]:
        if override:
            detail = (
                "while the pilot's switch overrides, Betaflight holds the last sticks indefinitely if MSP falls "
                "silent: only the pilot's switch ends that"
            )
            fine = self.identity.variant == INAV
            return [] if fine else [Diagnostic("silence", False, detail, "keep a thumb on the switch")]
        if self.failsafe is None:
            return [Diagnostic("failsafe", False, "its failsafe is unknown", _DOCS, severe=True)]
        found = []
        config, names = self.failsafe, _PROCEDURES[self.identity.variant]
        what = names[config.procedure] if config.procedure < len(names) else f"procedure {config.procedure}"
        nothing = self.identity.variant == INAV and config.procedure == _NOTHING
        detail = f"{config.delay_s:g} s after the sticks stop {what}"
        advice = "set failsafe_procedure = LAND or DROP" if nothing else ""
        found.append(Diagnostic("failsafe", not nothing, detail, advice, severe=True))
        if config.delay_s > LONG_DELAY_S:
            advice = f"set failsafe_delay = {LONG_DELAY_S * 10:g} or less"
            found.append(
                Diagnostic("failsafe delay", False, f"failsafe begins only after {config.delay_s:g} s", advice)
            )
        return found + self._held()

    def _held(self) -> list[Diagnostic]:
        """Check the stick values that apply between the loss of the receiver and the failsafe."""
        if self.identity.variant == BETAFLIGHT and len(self.on_loss) < len(USUAL_MAP):
            unknown = "its reaction to missing sticks before the failsafe is unknown"
            return [Diagnostic("held sticks", False, unknown, _DOCS, severe=True)]
        held = [
            name
            for name, (mode, _) in zip(("roll", "pitch", "yaw", "throttle"), self.on_loss, strict=False)
            if mode == msp.OnLoss.HOLD
        ]
        if held:
            detail = f"without sticks it holds the last {', '.join(held)}: it would fly on"
            advice = "rxfail 0 a, rxfail 1 a, rxfail 2 a, rxfail 3 a"
            return [Diagnostic("held sticks", False, detail, advice, severe=True)]
        return []


def _straight(stick: float) -> float:
    return stick


def hindrances(diagnostics: list[Diagnostic]) -> str:
    """Return why the vehicle must not be armed, with advice; empty if no diagnostic is severe."""
    bad = [each for each in diagnostics if each.severe and not each.good]
    return "; ".join(f"{each.detail} ({each.advice})" if each.advice else each.detail for each in bad)


_INAV_TUNING: Final = 11  # number of bytes in INAV's RC_TUNING up to the expo for yaw
_MSP_RECEIVER: Final = 2  # value of INAV's receiver_type


Read = Callable[[MspSetup, bytes], dict[str, Any]]  #: returns the settings that a reply changes, or raises DecodeError


class Identification:
    """Requests everything that :class:`MspSetup` contains, then calls ``done``.

    The setup's variant is empty if the flight controller did not identify itself.
    """

    def __init__(self, questions: Questions, done: Callable[[MspSetup], None]) -> None:
        self.setup = MspSetup()
        self.missing: list[str] = []  #: unreadable settings that are needed before any sticks can be sent
        self._questions = questions
        self._done = done
        self._ask(Function.API_VERSION, lambda setup, data: _identity(setup, api=msp.api_version(data)))
        self._ask(Function.FC_VARIANT, lambda setup, data: _identity(setup, variant=msp.text(data, 4)))
        self._ask(Function.FC_VERSION, lambda setup, data: _identity(setup, version=msp.version(data)))
        self._ask(Function.BOARD_INFO, lambda setup, data: _identity(setup, board=msp.board(data)))

    def ask_settings(self) -> None:
        """Request the settings after the firmware has been identified."""
        ask = self._ask
        ask(Function.BOXIDS, lambda _, data: {"boxes": tuple((number, "") for number in data)}, "numbers of its modes")
        ask(Function.BOXNAMES, _box_names, "names of its modes")
        ask(Function.MODE_RANGES, lambda _, data: {"ranges": tuple(msp.mode_ranges(data))}, "switches of its modes")
        ask(Function.RX_MAP, lambda _, data: {"sticks": msp.rx_map(data), "sticks_known": True}, "order of its sticks")
        ask(Function.RX_CONFIG, lambda _, data: {"rx": msp.RxConfig.decode(data)})
        ask(Function.FAILSAFE_CONFIG, lambda _, data: {"failsafe": msp.FailsafeConfig.decode(data)})
        ask(Function.RC_TUNING, _tuning)
        if self.setup.identity.variant == BETAFLIGHT:
            ask(Function.FEATURE_CONFIG, lambda _, data: {"features": msp.features(data)})
            ask(Function.RXFAIL_CONFIG, lambda _, data: {"on_loss": tuple(msp.rx_fail(data))})
            ask(Function.PID_ADVANCED, lambda _, data: {"angle_limit_deg": float(msp.angle_limit_deg(data))})
            self._questions.ask(Function.BATTERY_CONFIG, self._on_last)
        else:
            ask(
                Function.COMMON_SETTING,
                lambda _, data: {"receiver_is_msp": data[0] == _MSP_RECEIVER} if data else {},
                payload=b"receiver_type\0",
            )
            self._questions.ask(Function.COMMON_SETTING, self._on_last, b"max_angle_inclination_rll\0")

    def _ask(self, function: Function, read: Read, needed: str = "", payload: bytes = b"") -> None:
        """Request settings; ``needed`` describes any that must be read before sticks can be sent."""

        def on_reply(reply: bytes | None) -> None:
            if reply is not None:
                with suppress(DecodeError):
                    self.setup = replace(self.setup, **read(self.setup, reply))
                    return
            if needed:
                self.missing.append(needed)

        self._questions.ask(function, on_reply, payload)

    def _on_last(self, payload: bytes | None) -> None:
        if payload is not None and self.setup.identity.variant == INAV and len(payload) >= 2:
            self.setup = replace(self.setup, angle_limit_deg=int.from_bytes(payload[:2], "little") / 10)
        elif payload is not None:
            with suppress(DecodeError):
                self.setup = replace(self.setup, cells=msp.CellVoltages.decode(payload))
        self._done(self.setup)


def _identity(setup: MspSetup, **known: Any) -> dict[str, Any]:
    return {"identity": replace(setup.identity, **known)}


def _box_names(setup: MspSetup, payload: bytes) -> dict[str, Any]:
    return {"boxes": tuple(zip((number for number, _ in setup.boxes), msp.box_names(payload), strict=False))}


def _tuning(setup: MspSetup, payload: bytes) -> dict[str, Any]:
    if setup.identity.variant == BETAFLIGHT:
        return {"rates": betaflight_rates(payload)}
    if len(payload) < _INAV_TUNING:
        return {}
    # INAV: rate, expo for roll and pitch, rates of roll, pitch and yaw in 10 degrees/s, …, expo for yaw
    return {"inav_yaw_rate_deg_s": payload[4] * 10.0, "inav_expo": (payload[1], payload[10])}
