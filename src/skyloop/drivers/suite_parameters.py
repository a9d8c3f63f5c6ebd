"""The driver suite's checks of parameters: whether a value fits its description, and another value that does."""

from __future__ import annotations

import math
from typing import Final

from skyloop.messages import Parameter, ParameterType, Value

_TYPES: Final[dict[ParameterType, tuple[type, ...]]] = {
    ParameterType.BOOL: (bool,),
    ParameterType.INT: (int,),
    ParameterType.FLOAT: (float, int),
    ParameterType.TEXT: (str,),
    ParameterType.VECTOR: (tuple,),
}


def mismatch(parameter: Parameter, value: Value) -> str:
    """Say why a value does not fit a parameter's description.

    Args:
        parameter: The description: type, choices, range.
        value: To be checked.

    Returns:
        The end of a sentence about the value, empty if it fits.
    """
    expected = _TYPES[parameter.type]
    if not isinstance(value, expected) or (isinstance(value, bool) and bool not in expected):
        return f"is not of type {parameter.type}"
    if parameter.choices and value not in parameter.choices:
        return f"is none of {parameter.choices}"
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        if isinstance(number, (str, bool)):
            continue
        if not math.isfinite(number):
            return "is not finite"
        if parameter.minimum is not None and number < parameter.minimum:
            return f"is below {parameter.minimum:g}"
        if parameter.maximum is not None and number > parameter.maximum:
            return f"is above {parameter.maximum:g}"
    return ""


def another_value(parameter: Parameter) -> Value:
    """Return a legal value other than the present one, or the present one if there is none."""
    value = parameter.value
    if parameter.choices:
        return next((choice for choice in parameter.choices if choice != value), value)
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return value
    if isinstance(value, tuple):
        return tuple(_another_number(number, parameter) for number in value)
    other = _another_number(value, parameter)
    return int(other) if parameter.type is ParameterType.INT else other


def _another_number(value: float, parameter: Parameter) -> float:
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:
        if parameter.type is ParameterType.INT:  # the next one: a vehicle may accept only some values of a wide range
            return value + 1 if value < high else value - 1
        return (value + low + high) / 3
    if high is not None:
        return min(high, value - 1)
    return value + 1


def same(one: Value, other: Value) -> bool:
    """Return whether two values are equal, numbers within a relative 1e-5 or an absolute 1e-6."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, (int, float)) and isinstance(other, (int, float)):
        return math.isclose(one, other, rel_tol=1e-5, abs_tol=1e-6)
    return one == other
