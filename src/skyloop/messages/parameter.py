"""Parameters: typed, with unit, range and default, so that a page or a person can edit them."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import msgspec

from skyloop.messages.feedback import Value

ParameterName = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]


class ParameterType(StrEnum):
    """The type of a parameter's value."""

    BOOL = "bool"
    INT = "int"
    FLOAT = "float"
    TEXT = "text"
    VECTOR = "vector"  #: a fixed number of floats


class Parameter(msgspec.Struct, frozen=True, array_like=True):
    """One parameter with its present value and all that is needed to check a new one."""

    name: ParameterName
    type: ParameterType
    value: Value
    unit: str = ""  #: SI symbol, e.g. ``rad``; empty for none
    minimum: float | None = None
    maximum: float | None = None
    default: Value | None = None
    choices: tuple[Value, ...] = ()  #: if not empty, the only values allowed
    read_only: bool = False
    description: str = ""
    momentary: bool = False  #: writing it does something once, such as a flip: no value to be restored or repeated
