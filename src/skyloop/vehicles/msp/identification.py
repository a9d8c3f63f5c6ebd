"""Finds out who the flight controller is and how it is set up, question by question. Pure."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Final

from skyloop.errors import DecodeError
from skyloop.vehicles.msp.firmware import Setup
from skyloop.vehicles.msp.telemetry import Questions
from skyloop.vehicles.msp.wire import messages as msp
from skyloop.vehicles.msp.wire.firmwares import betaflight_rates
from skyloop.vehicles.msp.wire.messages import BETAFLIGHT, INAV, Function

_INAV_TUNING: Final = 7  # bytes of RC_TUNING up to the yaw rate
_MSP_RECEIVER: Final = 2  # INAV's receiver_type


class Identification:
    """Asks for everything that :class:`Setup` holds.

    Args:
        questions: Where it asks.
        done: Called at the end; the setup's variant is empty if the flight controller did not say who it is.
    """

    def __init__(self, questions: Questions, done: Callable[[Setup], None]) -> None:
        self.setup = Setup()
        self.missing: list[str] = []  #: what must be known to send it any sticks, and could not be read
        self._questions = questions
        self._done = done
        for function, handler in (
            (Function.API_VERSION, self._on_api),
            (Function.FC_VARIANT, self._on_variant),
            (Function.FC_VERSION, self._on_version),
            (Function.BOARD_INFO, self._on_board),
        ):
            questions.ask(function, _reading(handler))

    def _identify(self, **known: object) -> None:
        self.setup = replace(self.setup, identity=replace(self.setup.identity, **known))  # type: ignore[arg-type]

    def _on_api(self, payload: bytes) -> None:
        self._identify(api=msp.api_version(payload))

    def _on_variant(self, payload: bytes) -> None:
        self._identify(variant=msp.text(payload, 4))

    def _on_version(self, payload: bytes) -> None:
        self._identify(version=msp.version(payload))

    def _on_board(self, payload: bytes | None) -> None:
        if payload is not None:
            self._identify(board=msp.board(payload))

    def ask_settings(self) -> None:
        """Go on with the settings, once it is known who it is."""
        ask = self._questions.ask
        for what, function, handler in (
            ("numbers of its modes", Function.BOXIDS, self._on_box_numbers),
            ("names of its modes", Function.BOXNAMES, self._on_box_names),
            ("switches of its modes", Function.MODE_RANGES, self._on_ranges),
            ("order of its sticks", Function.RX_MAP, self._on_sticks),
        ):
            ask(function, _reading(handler, partial(self.missing.append, what)))
        for function, handler in (
            (Function.RX_CONFIG, self._on_rx),
            (Function.FAILSAFE_CONFIG, self._on_failsafe),
            (Function.RC_TUNING, self._on_tuning),
        ):
            ask(function, _reading(handler))
        if self.setup.identity.variant == BETAFLIGHT:
            ask(Function.FEATURE_CONFIG, _reading(self._on_features))
            ask(Function.RXFAIL_CONFIG, _reading(self._on_rx_fail))
            ask(Function.PID_ADVANCED, _reading(self._on_angle_limit))
            ask(Function.BATTERY_CONFIG, self._on_last)
        else:
            ask(Function.COMMON_SETTING, _reading(self._on_receiver_type), b"receiver_type\0")
            ask(Function.COMMON_SETTING, self._on_last, b"max_angle_inclination_rll\0")

    def _on_box_numbers(self, payload: bytes) -> None:
        self.setup = replace(self.setup, boxes=tuple((number, "") for number in payload))

    def _on_box_names(self, payload: bytes) -> None:
        numbers = [number for number, _ in self.setup.boxes]
        self.setup = replace(self.setup, boxes=tuple(zip(numbers, msp.box_names(payload), strict=False)))

    def _on_ranges(self, payload: bytes) -> None:
        self.setup = replace(self.setup, ranges=tuple(msp.mode_ranges(payload)))

    def _on_sticks(self, payload: bytes) -> None:
        self.setup = replace(self.setup, sticks=msp.rx_map(payload), sticks_told=True)

    def _on_rx(self, payload: bytes) -> None:
        self.setup = replace(self.setup, rx=msp.RxConfig.decode(payload))

    def _on_failsafe(self, payload: bytes) -> None:
        self.setup = replace(self.setup, failsafe=msp.FailsafeConfig.decode(payload))

    def _on_tuning(self, payload: bytes) -> None:
        if self.setup.identity.variant == BETAFLIGHT:
            self.setup = replace(self.setup, rates=betaflight_rates(payload))
        elif len(payload) >= _INAV_TUNING + 4:
            # INAV: rate, expo of roll and pitch, rates of roll, pitch and yaw in 10 degrees/s, …, expo of yaw
            expo = payload[1], payload[10]
            self.setup = replace(self.setup, inav_yaw_rate_deg_s=payload[4] * 10.0, inav_expo=expo)

    def _on_features(self, payload: bytes) -> None:
        self.setup = replace(self.setup, features=msp.features(payload))

    def _on_rx_fail(self, payload: bytes) -> None:
        self.setup = replace(self.setup, on_loss=tuple(msp.rx_fail(payload)))

    def _on_angle_limit(self, payload: bytes) -> None:
        self.setup = replace(self.setup, angle_limit_deg=float(msp.angle_limit_deg(payload)))

    def _on_receiver_type(self, payload: bytes) -> None:
        if payload:
            self.setup = replace(self.setup, receiver_is_msp=payload[0] == _MSP_RECEIVER)

    def _on_last(self, payload: bytes | None) -> None:
        if payload is not None and self.setup.identity.variant == INAV and len(payload) >= 2:
            self.setup = replace(self.setup, angle_limit_deg=int.from_bytes(payload[:2], "little") / 10)
        elif payload is not None:
            with suppress(DecodeError):
                self.setup = replace(self.setup, cells=msp.CellVoltages.decode(payload))
        self._done(self.setup)


def _reading(
    handler: Callable[[bytes], None], otherwise: Callable[[], None] = lambda: None
) -> Callable[[bytes | None], None]:
    """Return a handler that calls ``otherwise`` for what is not known, or can't be read."""

    def read(payload: bytes | None) -> None:
        if payload is not None:
            with suppress(DecodeError):
                handler(payload)
                return
        otherwise()

    return read
