"""Reads and writes the parameters of one opened driver."""

from __future__ import annotations

import msgspec

from skyloop.drivers.tello.link import Link
from skyloop.drivers.tello.parameters import (
    CAMERA,
    FLIP,
    FLIPS,
    FULL,
    LIMITS,
    NO_FLIP,
    SETTINGS,
    Setting,
    command_of,
    flip_parameter,
    known_settings,
    scale_parameters,
    scaled,
    told_parameters,
)
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, Refusal, Value
from skyloop.wire.tello.replies import is_error


class DroneSettings:
    """What was written lives here; the link carries it to the drone."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._values: dict[str, Value] = {name: setting.parameter.value for name, setting in SETTINGS.items()}
        self._values["tello.mission_pads"] = link.session.options.pads
        self._flip = NO_FLIP

    @property
    def camera(self) -> str:
        """Whose pictures come."""
        return str(self._values[CAMERA])

    def parameters(self) -> list[Parameter]:
        """All, with their present values."""
        with self._link.lock:
            session = self._link.session
            pilot, sdk, serial = session.pilot, session.sdk, session.serial
            scales = scale_parameters(pilot.limits, pilot.full)
        kept = [
            msgspec.structs.replace(setting.parameter, value=self._values[name])
            for name, setting in known_settings(sdk).items()
        ]
        return [*scales, flip_parameter(self._flip), *kept, *told_parameters(sdk, serial)]

    def write(self, name: str, value: Value) -> Value:
        """Takes up to 0.95 s. Raises :class:`UnknownNameError` and :class:`ParameterError`."""
        known = {parameter.name: parameter for parameter in self.parameters()}
        if name not in known:
            raise UnknownNameError("parameter of the Tello", name, known)
        parameter = known[name]
        if parameter.read_only:
            raise ParameterError(f"{name} can only be read", code=Refusal.READ_ONLY)
        if name.startswith((LIMITS, FULL)):
            return self._scale(parameter, value)
        if name == FLIP:
            return self._do_flip(value)
        return self._configure(SETTINGS[name], value)

    def _scale(self, parameter: Parameter, value: Value) -> Value:
        with self._link.lock:
            pilot = self._link.session.pilot
            if parameter.name.startswith(LIMITS):
                pilot.limits = scaled(pilot.limits, parameter, value)
            else:
                pilot.full = scaled(pilot.full, parameter, value)
        assert isinstance(value, int | float)
        return float(value)

    def _do_flip(self, value: Value) -> Value:
        if value != NO_FLIP and value not in FLIPS:
            raise ParameterError(str(UnknownNameError(FLIP, str(value), FLIPS)), code=Refusal.OUT_OF_RANGE)
        if value != NO_FLIP:
            with self._link.lock:
                session = self._link.session
                if not session.pilot.watch.in_air:
                    raise ParameterError("a flip is for a drone in the air: take off first", code=Refusal.WRONG_STATE)
                session.flip(FLIPS[str(value)])
        self._flip = str(value)
        return value

    def _configure(self, setting: Setting, value: Value) -> Value:
        command = command_of(setting, value)
        reply = self._link.ask(command)
        name = setting.parameter.name
        if reply is None:
            raise ParameterError(
                f"{name}: the drone did not answer {command!r}; it answers nothing while it takes off or lands",
                code=Refusal.DRIVER_FAILED,
            )
        if is_error(reply):
            raise ParameterError(f"{name}: the drone answers {command!r} with {reply!r}")
        self._values[name] = value
        with self._link.lock:
            self._link.session.remembered[name] = command
        return value
