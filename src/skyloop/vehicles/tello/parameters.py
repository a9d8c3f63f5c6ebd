"""The driver's and the drone's settings as parameters, and how to write them.

The drone's settings can't be queried, so the driver returns the last written value, and resends it after a link loss.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import msgspec

from skyloop.drivers.base import checked_value
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.vehicles.tello.link import TelloLink
from skyloop.vehicles.tello.setpoints import Scale
from skyloop.vehicles.tello.video import BOTTOM, FRONT
from skyloop.vehicles.tello.wire import Sdk, is_error

NO_FLIP: Final = "none"
FLIPS: Final = {"left": "l", "right": "r", "forward": "f", "back": "b"}
FLIP: Final = "tello.flip"
CAMERA: Final = "camera.active"
_GREATEST: Final = 10.0  # upper bound of speeds [m/s] and of the yaw rate [rad/s], beyond what a Tello can do


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting stored in the drone, with its parameter, the first SDK that has it, and the command for each value."""

    parameter: Parameter
    since: Sdk
    commands: dict[Value, str]


def _choice(
    name: str, since: Sdk, commands: dict[Value, str], default: Value, description: str, unit: str = ""
) -> Setting:
    kinds = {bool: ParameterType.BOOL, int: ParameterType.INT, str: ParameterType.TEXT}
    kind = kinds[type(default)]
    choices = () if kind is ParameterType.BOOL else tuple(commands)
    made = Parameter(name, kind, default, unit, default=default, choices=choices, description=description)
    return Setting(made, since, commands)


V2, V3 = Sdk.V2_0, Sdk.V3_0
SETTINGS: Final = {
    setting.parameter.name: setting
    for setting in (
        _choice("tello.mission_pads", V2, {True: "mon", False: "moff"}, False, "looks for mission pads (mon, moff)"),
        _choice(
            "tello.mission_pad_direction",
            V2,
            {"down": "mdirection 0", "forward": "mdirection 1", "both": "mdirection 2"},
            "both",
            "where to look for mission pads (mdirection): 20 times a second, or 10 for both",
        ),
        _choice(
            CAMERA,
            V3,
            {FRONT: "downvision 0", BOTTOM: "downvision 1"},
            FRONT,
            "the camera whose pictures the drone sends (downvision)",
        ),
        _choice(
            "camera.fps",
            V3,
            {5: "setfps low", 15: "setfps middle", 30: "setfps high"},
            30,
            "pictures a second (setfps)",
            "1/s",
        ),
        _choice(
            "camera.resolution",
            V3,
            {"high": "setresolution high", "low": "setresolution low"},
            "high",
            "resolution of the front camera (setresolution)",
        ),
        _choice(
            "camera.bitrate",
            V3,
            {rate: f"setbitrate {rate}" for rate in range(6)},
            0,
            "bitrate of the video; 0: chosen by the drone (setbitrate)",
            "Mbit/s",
        ),
    )
}
#: Each field of :class:`Scale` with its unit, range and description.
_SCALES: Final = (
    ("speed", "m/s", (0.05, _GREATEST), "horizontal speed along each axis"),
    ("climb", "m/s", (0.05, _GREATEST), "climb and descent"),
    ("yaw_rate", "rad/s", (0.05, _GREATEST), "yaw rate"),
    ("tilt", "rad", (0.01, 1.0), "roll and pitch"),
)
LIMITS: Final = "limits."
FULL: Final = "tello.full_stick."


def scale_parameters(limits: Scale, full: Scale) -> list[Parameter]:
    """Return the parameters for the limits of set-points and for the effect of a full stick."""
    usual = Scale()
    made = []
    for field, unit, (low, high), text in _SCALES:
        for prefix, scale, what in (
            (LIMITS, limits, f"greatest {text}; never more than a full stick"),
            (FULL, full, f"{text} of the drone at full stick: measure it to make set-points accurate"),
        ):
            name, value, default = f"{prefix}{field}", getattr(scale, field), getattr(usual, field)
            made.append(Parameter(name, ParameterType.FLOAT, value, unit, low, high, default, description=what))
    return made


def flip_parameter(value: str) -> Parameter:
    """Return the parameter that flips the drone when written."""
    return Parameter(
        FLIP,
        ParameterType.TEXT,
        value,
        default=NO_FLIP,
        choices=(NO_FLIP, *FLIPS),
        description="flips in this direction (sent once); in flight only",
        momentary=True,
    )


def reported_parameters(sdk: Sdk | None, serial: str) -> list[Parameter]:
    """Return the properties that the drone reports, as read-only parameters."""
    known = (
        ("tello.sdk", "" if sdk is None else sdk.value, "the firmware's SDK version"),
        ("tello.serial", serial, "the drone's serial number (sn?)"),
    )
    kind = ParameterType.TEXT
    return [Parameter(name, kind, text, read_only=True, description=what) for name, text, what in known if text]


def known_settings(sdk: Sdk | None) -> dict[str, Setting]:
    """Return the settings that this SDK version has; none while the version is unknown."""
    return {name: setting for name, setting in SETTINGS.items() if sdk is not None and sdk.knows(setting.since)}


class DroneSettings:
    """Holds the values of all parameters. The drone's own settings are written through the link."""

    def __init__(self, link: TelloLink) -> None:
        self._link = link
        self._values: dict[str, Value] = {name: setting.parameter.value for name, setting in SETTINGS.items()}
        self._values["tello.mission_pads"] = link.session.options.pads
        self._flip = NO_FLIP

    @property
    def camera(self) -> str:
        """The camera whose images the drone sends."""
        return str(self._values[CAMERA])

    def parameters(self) -> list[Parameter]:
        """Return all parameters with their current values."""
        with self._link.lock:
            session = self._link.session
            setpoints, sdk, serial = session.setpoints, session.sdk, session.serial
            scales = scale_parameters(setpoints.limits, setpoints.full)
        kept = [
            msgspec.structs.replace(setting.parameter, value=self._values[name])
            for name, setting in known_settings(sdk).items()
        ]
        return [*scales, flip_parameter(self._flip), *kept, *reported_parameters(sdk, serial)]

    def write(self, name: str, value: Value) -> Value:
        """Write a parameter and return the value in force afterwards. Takes up to 0.95 s.

        Raises an error for a wrong name or value, for a flip on the ground, or if the drone refuses or does not reply.
        """
        known = {parameter.name: parameter for parameter in self.parameters()}
        if name not in known:
            raise UnknownNameError("parameter of the Tello", name, known)
        parameter = known[name]
        if parameter.read_only:
            raise ParameterError(f"{name} can only be read", code=Refusal.READ_ONLY)
        value = checked_value(parameter, value)
        if name.startswith((LIMITS, FULL)):
            return self._scale(name, value)
        if name == FLIP:
            return self._do_flip(value)
        return self._configure(SETTINGS[name], value)

    def _scale(self, name: str, value: Value) -> Value:
        change: dict[str, Any] = {name.rpartition(".")[2]: value}
        with self._link.lock:
            setpoints = self._link.session.setpoints
            if name.startswith(LIMITS):
                setpoints.limits = replace(setpoints.limits, **change)
            else:
                setpoints.full = replace(setpoints.full, **change)
        return value

    def _do_flip(self, value: Value) -> Value:
        if value != NO_FLIP:
            with self._link.lock:
                session = self._link.session
                if session.setpoints.stop.active or not session.setpoints.watch.in_air:
                    raise ParameterError("a flip needs a drone in the air: take off first", code=Refusal.WRONG_STATE)
                session.flip(FLIPS[str(value)])
        self._flip = str(value)
        return value

    def _configure(self, setting: Setting, value: Value) -> Value:
        command = setting.commands[value]
        reply = self._link.ask(command)
        name = setting.parameter.name
        if reply is None:
            raise ParameterError(
                f"{name}: the drone did not answer {command!r}; it does not reply while taking off or landing",
                code=Refusal.DRIVER_FAILED,
            )
        if is_error(reply):
            raise ParameterError(f"{name}: the drone answers {command!r} with {reply!r}")
        self._values[name] = value
        with self._link.lock:
            self._link.session.remembered[name] = command
        return value
