"""The value of a processor's result to bytes and back: one MessagePack value, with NumPy's arrays.

An array is extension type 1, whose bytes are a MessagePack array of its type's name, its shape and its elements
(little-endian, row by row). A dataclass or ``msgspec.Struct`` is encoded as a map and decoded as a dict.
"""

from __future__ import annotations

from typing import Annotated, Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.errors import DecodeError, UsageError
from skyloop.messages.numbers import Count, shape_fits
from skyloop.messages.result import MAX_PAYLOAD

ARRAY: Final = 1  #: extension type
MAX_DIMENSIONS: Final = 8
MAX_DEPTH: Final = 32  #: of nested lists and maps, so that walking through a value needs a bounded stack
#: Types of arrays that travel: the same on every machine.
DTYPES: Final = (
    "bool",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
    *(f"float{bits}" for bits in (16, 32, 64)),
)
_WHAT: Final = (
    "None, bool, int (of 64 bits), float, str, bytes, list, tuple, dict, dataclass, msgspec.Struct and NumPy arrays of "
    "numbers can be sent"
)


class _Array(msgspec.Struct, frozen=True, array_like=True):
    dtype: str
    shape: Annotated[tuple[Count, ...], msgspec.Meta(max_length=MAX_DIMENSIONS)]
    data: bytes


def pack(value: Any) -> bytes:
    """Encode a value.

    Args:
        value: None, bool, int (64 bits), float, str, bytes, list, tuple, dict, dataclass, ``msgspec.Struct`` or a NumPy
            array of :data:`DTYPES`, nested at most :data:`MAX_DEPTH` deep.

    Raises:
        UsageError: It can't be encoded, or takes more than 32 768 bytes.
    """
    try:
        data = _encoder.encode(value)
        if len(data) <= MAX_PAYLOAD:
            _check_depth(_plain_decoder.decode(data))
    except (TypeError, ValueError, OverflowError, RecursionError, msgspec.MsgspecError) as error:
        raise UsageError(f"a result can't be sent: {error}; {_WHAT}") from None
    if len(data) > MAX_PAYLOAD:
        raise UsageError(
            f"a result of {len(data)} bytes can't be sent, at most {MAX_PAYLOAD} can: send what was found in an "
            "image, not the image"
        )
    return data


def unpack(payload: bytes) -> Any:
    """Decode a payload; arrays are read-only, tuples come back as lists.

    Raises:
        DecodeError: It is not a value that :func:`pack` could have encoded.
    """
    try:
        value = _decoder.decode(payload)
        _check_depth(value)
    except (msgspec.MsgspecError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DecodeError(f"a result that can't be understood: {error}") from None
    return value


def _check_depth(value: Any) -> None:
    """Raise ``ValueError`` for lists and maps in one another deeper than :data:`MAX_DEPTH`, without recursion."""
    level = [value]
    for _ in range(MAX_DEPTH + 1):
        inside: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                inside += (*item, *item.values())
            elif isinstance(item, list | tuple):
                inside += item
        if not inside:
            return
        level = inside
    raise ValueError(f"lists and maps in it lie more than {MAX_DEPTH} deep in one another")


def _encode_other(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return msgspec.msgpack.Ext(ARRAY, _pack_array(value))
    raise TypeError(f"there is a {type(value).__module__}.{type(value).__qualname__} in it")


def _pack_array(array: NDArray[Any]) -> bytes:
    if array.dtype.name not in DTYPES or array.ndim > MAX_DIMENSIONS:
        raise TypeError(
            f"there is an array of {array.ndim} dimensions of {array.dtype} in it, and arrays have at most "
            f"{MAX_DIMENSIONS} dimensions of {', '.join(DTYPES)}"
        )
    if array.nbytes > MAX_PAYLOAD or not shape_fits(array.shape, array.size, MAX_PAYLOAD):
        raise ValueError(
            f"there is an array of {array.nbytes} bytes in it, of shape {array.shape}, and results have at most "
            f"{MAX_PAYLOAD} bytes, and no axis that is longer"
        )
    plain = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return msgspec.msgpack.encode(_Array(array.dtype.name, array.shape, plain.tobytes()))


def _decode_extension(code: int, data: memoryview) -> Any:
    if code != ARRAY:
        raise ValueError(f"extension type {code} is not known")
    packed = _array_decoder.decode(data)
    if packed.dtype not in DTYPES:
        raise ValueError(f"an array of {packed.dtype[:40]!r}")
    dtype = np.dtype(packed.dtype).newbyteorder("<")
    count, rest = divmod(len(packed.data), dtype.itemsize)
    if rest or not shape_fits(packed.shape, count, MAX_PAYLOAD):
        raise ValueError(
            f"an array of shape {packed.shape!r:.200} and type {packed.dtype} with {len(packed.data)} bytes"
        )
    return np.frombuffer(packed.data, dtype).reshape(packed.shape).astype(packed.dtype, copy=False)


_encoder = msgspec.msgpack.Encoder(enc_hook=_encode_other)
_decoder = msgspec.msgpack.Decoder(ext_hook=_decode_extension)
_plain_decoder = msgspec.msgpack.Decoder()  # arrays of numbers stay bytes
_array_decoder = msgspec.msgpack.Decoder(_Array)
