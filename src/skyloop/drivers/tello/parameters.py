"""The driver's and the drone's settings as parameters. Pure.

The drone can't be asked what is set: what was written last is shown, and said again after the drone was lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from skyloop.drivers.tello.cameras import BOTTOM, FRONT
from skyloop.drivers.tello.sticks import Scale
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.wire.tello.commands import Sdk

NO_FLIP: Final = "none"
FLIPS: Final = {"left": "l", "right": "r", "forward": "f", "back": "b"}
FLIP: Final = "tello.flip"
CAMERA: Final = "camera.active"
_GREATEST: Final = 10.0


@dataclass(frozen=True, slots=True)
class Setting:
    """One that the drone keeps: its parameter, since which SDK it is there, and the command of each value."""

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


SETTINGS: Final = {
    setting.parameter.name: setting
    for setting in (
        _choice(
            "tello.mission_pads", Sdk.V2_0, {True: "mon", False: "moff"}, False, "looks for mission pads (mon, moff)"
        ),
        _choice(
            "tello.mission_pad_direction",
            Sdk.V2_0,
            {"down": "mdirection 0", "forward": "mdirection 1", "both": "mdirection 2"},
            "both",
            "where to look for mission pads (mdirection): 20 times a second, or 10 for both",
        ),
        _choice(
            CAMERA,
            Sdk.V3_0,
            {FRONT: "downvision 0", BOTTOM: "downvision 1"},
            FRONT,
            "the camera whose pictures the drone sends (downvision)",
        ),
        _choice(
            "camera.fps",
            Sdk.V3_0,
            {5: "setfps low", 15: "setfps middle", 30: "setfps high"},
            30,
            "pictures a second (setfps)",
            "1/s",
        ),
        _choice(
            "camera.resolution",
            Sdk.V3_0,
            {"high": "setresolution high", "low": "setresolution low"},
            "high",
            "of the front camera (setresolution)",
        ),
        _choice(
            "camera.bitrate",
            Sdk.V3_0,
            {rate: f"setbitrate {rate}" for rate in range(6)},
            0,
            "of the video; 0: as the drone sees fit (setbitrate)",
            "Mbit/s",
        ),
    )
}
#: Parameter, field of :class:`Scale`, unit, range, description.
_SCALES: Final = (
    ("speed", "speed", "m/s", (0.05, _GREATEST), "horizontal speed along each axis"),
    ("climb", "climb", "m/s", (0.05, _GREATEST), "climb and descent"),
    ("yaw_rate", "yaw_rate", "rad/s", (0.05, _GREATEST), "yaw rate"),
    ("tilt", "tilt", "rad", (0.01, 1.0), "roll and pitch"),
)
LIMITS: Final = "limits."
FULL: Final = "tello.full_stick."


def scale_parameters(limits: Scale, full: Scale) -> list[Parameter]:
    """What is asked for at most, and what a full stick is taken for."""
    usual = Scale()
    made = []
    for name, field, unit, (low, high), text in _SCALES:
        for prefix, scale, what in (
            (LIMITS, limits, f"greatest {text}; never more than a full stick"),
            (FULL, full, f"{text} that the drone makes of a full stick: measure it, and set-points come true"),
        ):
            value, default = getattr(scale, field), getattr(usual, field)
            made.append(
                Parameter(
                    f"{prefix}{name}", ParameterType.FLOAT, value, unit, low, high, default=default, description=what
                )
            )
    return made


def scaled(scale: Scale, parameter: Parameter, value: Value) -> Scale:
    """With this one changed. Raises :class:`ParameterError`."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ParameterError(f"{parameter.name} takes a number, not {value!r:.60}", code=Refusal.WRONG_TYPE)
    low, high = parameter.minimum, parameter.maximum
    assert low is not None
    assert high is not None
    if not low <= value <= high:
        raise ParameterError(f"{parameter.name} is from {low:g} to {high:g}, not {value!r}", code=Refusal.OUT_OF_RANGE)
    return replace(scale, **{parameter.name.rpartition(".")[2]: float(value)})


def flip_parameter(value: str) -> Parameter:
    """Writing it flips the drone."""
    return Parameter(
        FLIP,
        ParameterType.TEXT,
        value,
        default=NO_FLIP,
        choices=(NO_FLIP, *FLIPS),
        description="flips this way (said once); in flight only",
    )


def told_parameters(sdk: Sdk | None, serial: str) -> list[Parameter]:
    """What the drone said of itself."""
    made = []
    if sdk is not None:
        made.append(
            Parameter("tello.sdk", ParameterType.TEXT, sdk.value, read_only=True, description="of the firmware")
        )
    if serial:
        made.append(
            Parameter(
                "tello.serial", ParameterType.TEXT, serial, read_only=True, description="the drone's number (sn?)"
            )
        )
    return made


def known_settings(sdk: Sdk | None) -> dict[str, Setting]:
    """Those that this version has."""
    return {name: setting for name, setting in SETTINGS.items() if sdk is not None and sdk.knows(setting.since)}


def command_of(setting: Setting, value: Value) -> str:
    """What sets it. Raises :class:`ParameterError`."""
    parameter = setting.parameter
    if type(value) is not type(parameter.value):
        raise ParameterError(
            f"{parameter.name} takes a {parameter.type.value}, not {value!r:.60}", code=Refusal.WRONG_TYPE
        )
    if value not in setting.commands:
        names = [str(choice) for choice in setting.commands]
        raise ParameterError(str(UnknownNameError(parameter.name, str(value), names)), code=Refusal.OUT_OF_RANGE)
    return setting.commands[value]
