"""The ranges that numbers of samples are checked for when they are decoded.

A sample may come from anybody who may connect, and many programs use what is in it: as a size, an index, a time or
the bound of a loop. So its numbers are bounded here once, where it comes in, and not at each place of use.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Annotated, Final

import msgspec

#: What counts up: sequence numbers, leases, numbers of applications. Python's ints have no end, others' have 64 bits.
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]

#: 73 years: beyond what a monotonic clock shows, and little enough that a time, an offset between two clocks and the
#: Unix time of their start can be added up in 64 bits.
LATEST_NS: Final = 2**61
#: A time on a monotonic clock [ns].
TimeNs = Annotated[int, msgspec.Meta(ge=-LATEST_NS, le=LATEST_NS)]

#: A number that is neither NaN nor infinite.
Finite = Annotated[float, msgspec.Meta(ge=-sys.float_info.max, le=sys.float_info.max)]


def shape_fits(shape: Sequence[int], count: int, most: int) -> bool:
    """Return whether an array of this shape has the given number of elements and no axis of excessive length.

    An axis of length 0 makes any other lengths fit, and a loop over those would never end. So the lengths are also
    multiplied with each 0 taken as 1, and bounded.

    Args:
        shape: The length of each axis.
        count: The number of elements.
        most: The largest product of the lengths, each 0 taken as 1.
    """
    return math.prod(shape) == count and math.prod(max(1, length) for length in shape) <= most
