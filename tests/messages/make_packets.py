"""Write the packets in ``tests/data/packets``; run this only for a new version of the wire format.

python -m tests.messages.make_packets
"""

from pathlib import Path

import msgspec

from skyloop.messages import Kind, encode
from skyloop.messages.codec import HEADER, MAX_BODY, SIGNATURE, VERSION
from tests.support.samples import SAMPLES

FOLDER = Path(__file__).parents[1] / "data" / "packets"


def packed(body: bytes, kind: int = Kind.COMMAND, **changes: int) -> bytes:
    return (
        HEADER.pack(
            SIGNATURE,
            changes.get("version", VERSION),
            kind,
            changes.get("reserved", 0),
            changes.get("length", len(body)),
        )
        + body
    )


GOOD = msgspec.msgpack.encode([1, 7, 3, 99, [7, 0.5, 0.0, 0.0, 0.0]])

#: name: (packet, what the error must match)
INVALID: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "0 bytes are too few"),
    "header-cut": (packed(GOOD)[:11], "11 bytes are too few"),
    "signature": (b"SKYX" + packed(GOOD)[4:], "signature b'SKYX'"),
    "version": (packed(GOOD, version=2), "version 2 is not 1"),
    "kind": (packed(GOOD, kind=63), "unknown kind 63"),
    "reserved": (packed(GOOD, reserved=1), "reserved bytes"),
    "length-short": (packed(GOOD, length=len(GOOD) - 1), "header announces"),
    "length-long": (packed(GOOD, length=len(GOOD) + 1), "header announces"),
    "oversized": (packed(b"\xc0" * (MAX_BODY + 1)), "exceed the 60000"),
    "body-cut": (packed(GOOD[:-3]), "truncated"),
    "body-trailing": (packed(GOOD + b"\xc0"), "trailing"),
    "body-not-array": (packed(msgspec.msgpack.encode({"seq": 1})), "Expected `array`, got `object`"),
    "seq-negative": (packed(msgspec.msgpack.encode([-1, 7, 3, 99, [2]])), "Expected `int` >= 0"),
    "seq-text": (packed(msgspec.msgpack.encode(["1", 7, 3, 99, [2]])), "Expected `int`, got `str`"),
    "action-unknown": (packed(msgspec.msgpack.encode([1, 7, 3, 99, [99]])), "Invalid value 99"),
    "fields-missing": (packed(msgspec.msgpack.encode([1, 7, 3])), "at least length 5"),
    "state-unknown": (packed(msgspec.msgpack.encode([1, "levitating"]), kind=Kind.FEEDBACK), "Invalid enum value"),
    "priority-32": (packed(msgspec.msgpack.encode([1, [2, 32, True]]), kind=Kind.REQUEST), "<= 31"),
    "name-long": (packed(msgspec.msgpack.encode([1, [1, "n" * 65, "pilot"]]), kind=Kind.REQUEST), "length <= 64"),
}


def main() -> None:
    for folder in ("golden", "invalid"):
        (FOLDER / folder).mkdir(parents=True, exist_ok=True)
    for name, sample in SAMPLES.items():
        (FOLDER / "golden" / f"{name}.bin").write_bytes(encode(sample))
    for name, (data, reason) in INVALID.items():
        (FOLDER / "invalid" / f"{name}.bin").write_bytes(data)
        (FOLDER / "invalid" / f"{name}.txt").write_text(reason + "\n")


if __name__ == "__main__":
    main()
