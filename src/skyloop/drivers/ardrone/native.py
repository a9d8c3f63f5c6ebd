"""The options of navdata as ``feedback.native``: flat names such as ``demo.vx``, in the drone's own units. Pure."""

from __future__ import annotations

import math
import re
from typing import Any, Final

from skyloop.messages import Value
from skyloop.wire.ardrone.navdata import Navdata
from skyloop.wire.ardrone.options import LAYOUTS, Demo, VisionDetect


def _name(kind: type[Any]) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower()


#: Of each option the names of its fields.
_FIELDS: Final = {kind: tuple(f"{_name(kind)}.{field}" for field in kind._fields) for kind in LAYOUTS}
#: Tags by the options' names, as ``navdata_options`` of an address takes them.
OPTION_TAGS: Final = {_name(kind): layout.tag for kind, layout in LAYOUTS.items()}
#: Of the demo mode's usual options only what says something: the drone's matrices are deprecated, and most tags empty.
_DEMO_FIELDS: Final = len(Demo._fields) - 6


def native_of(navdata: Navdata, *, everything: bool) -> dict[str, Value]:
    """All options of a datagram; numbers that are not finite are left out.

    Without ``everything`` the deprecated matrices of the demo option and an empty list of tags are left out as well.
    """
    native: dict[str, Value] = {"state": int(navdata.state), "sequence": navdata.sequence}
    for kind, option in navdata.options.items():
        names: tuple[str, ...] = _FIELDS[kind]
        fields: tuple[Value, ...] = option
        if not everything and kind is Demo:
            names = names[:_DEMO_FIELDS]
        elif not everything and isinstance(option, VisionDetect) and not option.detected:
            names = names[:1]
        for name, value in zip(names, fields, strict=False):
            if type(value) is int or _finite(value):
                native[name] = value
    return native


def _finite(value: Any) -> bool:
    return all(map(math.isfinite, value)) if type(value) is tuple else math.isfinite(value)
