"""Values of results: round trips and refusals."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

from skyloop.errors import DecodeError, UsageError
from skyloop.messages.relayed import ARRAY, DTYPES, MAX_PAYLOAD, pack, unpack

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)


def same(a: Any, b: Any) -> bool:
    """Return whether two values are equal, with NaN equal to NaN."""
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (math.isnan(a) and math.isnan(b))
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return type(a) is type(b) and bool(a == b)


@given(PLAIN)
def test_plain_values_survive_a_round_trip(value: Any) -> None:
    assert same(unpack(pack(value)), value)


@given(
    st.sampled_from(DTYPES).flatmap(
        lambda name: npst.arrays(
            np.dtype(name).newbyteorder(">"), npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
        )
    )
)
def test_arrays_keep_type_and_shape(array: NDArray[Any]) -> None:
    back = unpack(pack({"array": array}))["array"]
    assert back.dtype == array.dtype.newbyteorder("=")
    assert back.shape == array.shape
    assert not back.flags.writeable
    np.testing.assert_array_equal(back, array)


@dataclass
class Box:
    x: float
    label: str


class Mark(msgspec.Struct):
    id: int


def test_typical_results() -> None:
    value = {"boxes": [Box(1.5, "cat")], "marks": (Mark(7),), "best": np.float32(0.5), "count": np.int64(3)}
    assert unpack(pack(value)) == {
        "boxes": [{"x": 1.5, "label": "cat"}],
        "marks": [{"id": 7}],
        "best": 0.5,
        "count": 3,
    }


CIRCLE: list[Any] = []
CIRCLE.append(CIRCLE)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"who": object()}, "contains a builtins.object; None, bool"),
        (lambda: 0, "contains a builtins.function"),
        (2**70, "can't serialize ints"),
        (CIRCLE, "recursion"),
        (np.zeros(2, complex), "an array of 1 dimensions of complex128; arrays have"),
        (np.zeros((1,) * 9), "an array of 9 dimensions"),
        (np.zeros((240, 320, 3), np.uint8), "an array of 230400 bytes"),
        ("x" * MAX_PAYLOAD, f"a result of {MAX_PAYLOAD + 3} bytes can't be sent, at most {MAX_PAYLOAD}"),
    ],
)
def test_unsendable_values_raise_with_a_reason(value: Any, words: str) -> None:
    with pytest.raises(UsageError, match="can't be sent") as raised:
        pack(value)
    assert words in str(raised.value)


def extension(*fields: Any) -> bytes:
    return msgspec.msgpack.encode(msgspec.msgpack.Ext(ARRAY, msgspec.msgpack.encode(fields)))


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        pack([1, 2])[:-1],
        pack(1) + b"\0",
        b"\x91" * 5000,
        msgspec.msgpack.encode(msgspec.msgpack.Ext(5, b"x")),
        extension("object", (1,), b"12345678"),
        extension("float64", (2,), b"12345678"),
        extension("uint8", (-1,), b""),
        extension("uint8", (30_000, 30_000), b""),
        extension("uint8", (1,) * 9, b"1"),
        extension("uint8"),
        msgspec.msgpack.encode(msgspec.msgpack.Ext(ARRAY, b"\xc1")),
    ],
)
def test_hostile_payloads_are_refused(payload: bytes) -> None:
    with pytest.raises(DecodeError, match="cannot decode"):
        unpack(payload)


@given(st.binary(max_size=64))
def test_noise_is_refused_or_decoded(noise: bytes) -> None:
    with contextlib.suppress(DecodeError):
        unpack(noise)
