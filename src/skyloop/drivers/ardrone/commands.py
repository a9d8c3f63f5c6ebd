"""The drone's commands that are no action of ours, as parameters: trims, calibration, animations. Pure.

Writing the parameter gives the command; its value then says what was last asked for. What the drone's state forbids is
refused with the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import msgspec

from skyloop.drivers.ardrone.animations import FIRST_FLIP, FLIGHT_ANIMATIONS, LED_ANIMATIONS, NO_ANIMATION
from skyloop.drivers.ardrone.pilot import Condition, Pilot
from skyloop.drivers.ardrone.sender import Message
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value

#: Takes a command and how many times it is to be said.
Say = Callable[[Message, int], None]

_REPEATS: Final = 3
_MAGNETOMETER: Final = 0  #: the device of ``CALIB``
_HALF_TURN: Final = 3.1416  #: rad, rounded up so that π itself fits


def _switch(name: str, description: str) -> Parameter:
    return Parameter(name, ParameterType.BOOL, False, default=False, description=description)


def _choice(name: str, names: tuple[str, ...], description: str) -> Parameter:
    choices = (NO_ANIMATION, *names)
    return Parameter(
        name, ParameterType.TEXT, NO_ANIMATION, default=NO_ANIMATION, choices=choices, description=description
    )


def _number(name: str, value: float, unit: str, low: float, high: float, description: str) -> Parameter:
    return Parameter(name, ParameterType.FLOAT, value, unit, low, high, value, description=description)


_LEDS: Final = _choice("leds.animation", LED_ANIMATIONS, "plays this animation of the lights (LED); none: nothing")
_LEDS_FREQUENCY: Final = _number("leds.frequency", 2.0, "1/s", 0.1, 50.0, "of the next animation of the lights")
_LEDS_DURATION: Final = _number(
    "leds.duration", 3.0, "s", 0.0, 3600.0, "of the next one, in whole seconds; 0: for ever"
)
_TRIM: Final = _switch("ardrone.flat_trim", "true: the drone takes its attitude for level (FTRIM); on the ground only")
_CALIBRATE: Final = _switch(
    "ardrone.calibrate_magnetometer", "true: the drone turns about itself to calibrate (CALIB); in flight only"
)
_ABSOLUTE: Final = _switch(
    "ardrone.absolute_control",
    "roll and pitch are along ardrone.absolute_heading and not along the drone's nose (PCMD_MAG)",
)
_HEADING: Final = _number(
    "ardrone.absolute_heading",
    0.0,
    "rad",
    -_HALF_TURN,
    _HALF_TURN,
    "heading that absolute control refers to: 0 is magnetic north, positive counter-clockwise",
)


def _flight_animations(version: int | None) -> Parameter:
    known = FLIGHT_ANIMATIONS[:FIRST_FLIP] if version == 1 else FLIGHT_ANIMATIONS
    names = tuple(name for name, _ in known)
    return _choice("ardrone.flight_animation", names, "flies this animation (ANIM, said once); in flight only")


class Commands:
    """The parameters and their values. ``pilot`` knows the drone's condition and takes absolute control."""

    def __init__(self, pilot: Pilot, say: Say) -> None:
        self._pilot = pilot
        self._say = say
        self._values: dict[str, Value] = {}

    def parameters(self, version: int | None) -> list[Parameter]:
        """Those that this version of the drone has."""
        known = [_LEDS, _LEDS_FREQUENCY, _LEDS_DURATION, _TRIM, _flight_animations(version)]
        if version != 1:
            known += [_CALIBRATE, _ABSOLUTE, _HEADING]
        return [self._present(parameter) for parameter in known]

    def write(self, parameter: Parameter, value: Value) -> Value:
        """Give the command; the value that is shown from now on. Raises :class:`ParameterError`."""
        value = _checked(parameter, value)
        name = parameter.name
        if name == _LEDS.name:
            self._light(str(value))
        elif name == _TRIM.name and value:
            self._give(("FTRIM", ()), on_ground=True)
        elif name == _CALIBRATE.name and value:
            self._give(("CALIB", (_MAGNETOMETER,)), on_ground=False)
        elif name == "ardrone.flight_animation" and value != NO_ANIMATION:
            self._fly(str(value))
        self._values[name] = value
        self._pilot.reference_rad = self._reference()
        return value

    def _present(self, parameter: Parameter) -> Parameter:
        return msgspec.structs.replace(parameter, value=self._values.get(parameter.name, parameter.value))

    def _reference(self) -> float | None:
        if not self._values.get(_ABSOLUTE.name, False):
            return None
        heading = self._values.get(_HEADING.name, 0.0)
        assert isinstance(heading, float)
        return heading

    def _light(self, name: str) -> None:
        self._condition()
        if name == NO_ANIMATION:
            return
        frequency = self._values.get(_LEDS_FREQUENCY.name, _LEDS_FREQUENCY.value)
        duration = self._values.get(_LEDS_DURATION.name, _LEDS_DURATION.value)
        assert isinstance(frequency, float)
        assert isinstance(duration, float)
        self._say(("LED", (LED_ANIMATIONS.index(name), frequency, round(duration))), _REPEATS)

    def _fly(self, name: str) -> None:
        number = next(at for at, (known, _) in enumerate(FLIGHT_ANIMATIONS) if known == name)
        # Said once: a repeat would fly it again.
        self._give(("ANIM", (number, FLIGHT_ANIMATIONS[number][1])), on_ground=False, times=1)

    def _give(self, message: Message, *, on_ground: bool, times: int = _REPEATS) -> None:
        condition = self._condition()
        if on_ground and condition.flying:
            raise _refused(f"{message[0]} is for a drone that stands level on the ground: land first")
        if not on_ground and (not condition.flying or condition.emergency):
            raise _refused(f"{message[0]} is for a drone in the air: take off first")
        self._say(message, times)

    def _condition(self) -> Condition:
        condition = self._pilot.condition
        if condition is None:
            raise _refused("the drone is not heard")
        return condition


def _checked(parameter: Parameter, value: Value) -> Value:
    """Of the parameter's type; a whole number is taken for a float."""
    if parameter.type is ParameterType.FLOAT and isinstance(value, int | float) and not isinstance(value, bool):
        low, high = parameter.minimum, parameter.maximum
        assert low is not None
        assert high is not None
        if not low <= value <= high:
            raise ParameterError(
                f"{parameter.name} is from {low:g} to {high:g}, not {value!r}", code=Refusal.OUT_OF_RANGE
            )
        return float(value)
    if type(value) is not type(parameter.value):
        raise ParameterError(
            f"{parameter.name} takes a {parameter.type.value}, not {value!r:.60}", code=Refusal.WRONG_TYPE
        )
    if parameter.choices and value not in parameter.choices:
        names = [str(choice) for choice in parameter.choices]
        raise ParameterError(str(UnknownNameError(parameter.name, str(value), names)), code=Refusal.OUT_OF_RANGE)
    return value


def _refused(why: str) -> ParameterError:
    return ParameterError(why, code=Refusal.WRONG_STATE)
