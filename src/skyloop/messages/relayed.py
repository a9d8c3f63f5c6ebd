"""Define samples that applications publish through the proxy: frame annotations, log entries, processor results.

The proxy relays them on the topics ``annotations``, ``logs``, ``results`` (of all processors) and ``results/NAME``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec

from skyloop.errors import DecodeError, UsageError
from skyloop.messages.fields import Count, Finite, Name, Pixels, Severity, TimeNs, shape_fits

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Annotations: drawings by a controller or a processor on a frame; the newest one wins. Coordinates are in frame pixels.

Point = tuple[Finite, Finite]
Channel = Annotated[int, msgspec.Meta(ge=0, le=255)]
Colour = tuple[Channel, Channel, Channel]  #: red, green, blue, 0 to 255
GREEN: Colour = (64, 220, 100)


class Polyline(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """A line through points, drawn on a frame; if closed, it is a polygon (a box has four points)."""

    points: Annotated[tuple[Point, ...], msgspec.Meta(max_length=512)]
    closed: bool = False
    colour: Colour = GREEN


class Points(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """Single points drawn on a frame."""

    points: Annotated[tuple[Point, ...], msgspec.Meta(max_length=1024)]
    colour: Colour = GREEN


class Text(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """Text drawn next to a point on a frame."""

    text: Annotated[str, msgspec.Meta(max_length=256)]
    at: Point
    colour: Colour = GREEN


Shape = Polyline | Points | Text


class Annotation(msgspec.Struct, frozen=True, array_like=True):
    """Shapes that a tracker or a controller draws over a frame, for people and recordings."""

    source: Name  #: who drew the shapes; only the newest annotation for each source and camera is valid
    camera: Name
    captured_ns: TimeNs  #: capture time of the annotated frame
    width: Pixels  #: width of that frame
    height: Pixels
    shapes: Annotated[tuple[Shape, ...], msgspec.Meta(max_length=256)] = ()


# Log entries: text, numbers and arrays, for recordings and plots.

MAX_LOG_TEXT: Final = 4096  #: maximum length of a log entry's text [characters]
MAX_VALUES: Final = 4096  #: maximum number of values in an array
MAX_DIMENSIONS: Final = 8  #: maximum number of dimensions of an array, here and in results
#: Name of the series that contains poses from motion capture, in world axes: arrays of x, y, z [m], the quaternion x,
#: y, z, w and, if known, the velocity x, y, z [m/s].
MOCAP: Final = "mocap"


class LogEntry(msgspec.Struct, frozen=True, array_like=True):
    """A log entry, which contains exactly one of ``text``, ``number`` and ``values``.

    Raises ``ValueError`` if it contains none or several of them, or if the shape does not match the values.
    """

    source: Name  #: application that logged the entry, or a component of it
    name: Annotated[str, msgspec.Meta(max_length=64)]  #: name of the series; empty for text without a series
    at_ns: TimeNs  #: time of the entry, on the proxy's clock
    text: Annotated[str, msgspec.Meta(max_length=MAX_LOG_TEXT)] | None = None
    number: Finite | None = None
    values: Annotated[tuple[Finite, ...], msgspec.Meta(max_length=MAX_VALUES)] | None = None  #: array, row by row
    shape: Annotated[tuple[Count, ...], msgspec.Meta(max_length=MAX_DIMENSIONS)] = ()  #: shape of the array
    severity: Severity = Severity.INFO  #: severity of a text

    def __post_init__(self) -> None:
        if (self.text is not None) + (self.number is not None) + (self.values is not None) != 1:
            raise ValueError("a log entry must have exactly one of text, number and values")
        values = self.values
        if self.shape if values is None else not shape_fits(self.shape, len(values), MAX_VALUES):
            raise ValueError(f"a log entry of {len(values or ())} values can't have the shape {self.shape!r:.200}")


# Results: a processor's output for one frame, and the division of frames among a processor's workers.

MAX_PAYLOAD: Final = 32_768  #: maximum size of a packed result [bytes]
MAX_CODE: Final = 128  #: maximum length of the text that identifies a processor's code [characters]
MAX_PARTS: Final = 1024  #: maximum number of parts into which a camera's frames are divided, one per worker
PROCESSOR_NAME: Final = r"^[A-Za-z0-9_.-]{1,64}$"
ProcessorName = Annotated[str, msgspec.Meta(pattern=PROCESSOR_NAME, min_length=1, max_length=64)]


class ProcessorResult(msgspec.Struct, frozen=True, array_like=True):
    """A processor's output for one frame."""

    processor: ProcessorName
    camera: Name
    seq: Count  #: number of the frame
    captured_ns: TimeNs  #: capture time of the frame
    made_ns: TimeNs  #: time at which the result was ready, on the proxy's clock
    took_ns: Count  #: time that the worker's ``process`` took [ns]
    number: Count  #: increases by one with each result of a worker
    payload: Annotated[bytes, msgspec.Meta(max_length=MAX_PAYLOAD)]  #: see :func:`pack`
    worker: Count = 0  #: number of the sending application, filled in by the proxy


class ProcessorShare(msgspec.Struct, frozen=True, array_like=True):
    """Assigns a worker its frames: those with ``seq % parts == part``."""

    processor: ProcessorName
    camera: Name
    part: Count  #: number of this worker's part of the frames, from 0
    #: number of parts; 1: every frame; 0: no frames, because the worker reported that it can't take any
    parts: Annotated[int, msgspec.Meta(ge=0, le=MAX_PARTS)]
    workers: Count  #: number of workers for this processor and camera, including paused workers

    def __post_init__(self) -> None:
        if self.part >= max(1, self.parts):
            raise ValueError(f"part is {self.part} and must be below parts ({self.parts}), or 0")


# The value of a result is a single MessagePack value. A NumPy array becomes extension type 1, whose bytes are a
# MessagePack array that contains the name of its type, its shape and its elements (little-endian, row by row). A
# dataclass or `msgspec.Struct` is encoded as a map and decoded as a dict.

ARRAY: Final = 1  #: extension type of arrays
MAX_DEPTH: Final = 32  #: maximum nesting of lists and maps, which bounds the stack needed to traverse a value
#: Allowed element types of arrays; these types are the same on every machine.
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
    """Encode a result's value. Raises :class:`UsageError` if it can't be encoded or takes more than 32 768 bytes.

    The value may be None, bool, int (64 bits), float, str, bytes, list, tuple, dict, dataclass, ``msgspec.Struct`` or a
    NumPy array of :data:`DTYPES`, with at most :data:`MAX_DEPTH` levels of nesting.
    """
    try:
        data = _encoder.encode(value)
        if len(data) <= MAX_PAYLOAD:
            _check_depth(_plain_decoder.decode(data))
    except (TypeError, ValueError, OverflowError, RecursionError, msgspec.MsgspecError) as error:
        raise UsageError(f"a result can't be sent: {error}; {_WHAT}") from None
    if len(data) > MAX_PAYLOAD:
        raise UsageError(
            f"a result of {len(data)} bytes can't be sent, at most {MAX_PAYLOAD} can: send what you found in an "
            "image, not the image"
        )
    return data


def unpack(payload: bytes) -> Any:
    """Decode a payload; arrays are read-only, and tuples become lists.

    Raises :class:`DecodeError` for bytes that :func:`pack` could not have encoded.
    """
    try:
        value = _decoder.decode(payload)
        _check_depth(value)
    except (msgspec.MsgspecError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DecodeError(f"cannot decode the result: {error}") from None
    return value


def _check_depth(value: Any) -> None:
    """Raise ``ValueError`` if lists and maps are nested deeper than :data:`MAX_DEPTH`; uses no recursion."""
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
    raise ValueError(f"lists and maps are nested more than {MAX_DEPTH} deep")


def _encode_other(value: Any) -> Any:
    import numpy as np

    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return msgspec.msgpack.Ext(ARRAY, _pack_array(value))
    raise TypeError(f"it contains a {type(value).__module__}.{type(value).__qualname__}")


def _pack_array(array: NDArray[Any]) -> bytes:
    import numpy as np

    if array.dtype.name not in DTYPES or array.ndim > MAX_DIMENSIONS:
        raise TypeError(
            f"it contains an array of {array.ndim} dimensions of {array.dtype}; arrays have at most "
            f"{MAX_DIMENSIONS} dimensions of {', '.join(DTYPES)}"
        )
    if array.nbytes > MAX_PAYLOAD or not shape_fits(array.shape, array.size, MAX_PAYLOAD):
        raise ValueError(
            f"it contains an array of {array.nbytes} bytes, of shape {array.shape}; results have at most "
            f"{MAX_PAYLOAD} bytes and no axis longer than that"
        )
    plain = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return msgspec.msgpack.encode(_Array(array.dtype.name, array.shape, plain.tobytes()))


def _decode_extension(code: int, data: memoryview) -> Any:
    import numpy as np

    if code != ARRAY:
        raise ValueError(f"extension type {code} is unknown")
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
_plain_decoder = msgspec.msgpack.Decoder()  # doesn't convert arrays of numbers, which remain bytes
_array_decoder = msgspec.msgpack.Decoder(_Array)
