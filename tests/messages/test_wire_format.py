"""``docs/wire-format.md`` matches the code: every table, tag, kind and vocabulary."""

from __future__ import annotations

import re
import struct
import typing
from enum import Enum, EnumMeta
from pathlib import Path

import msgspec
import pytest

from skyloop import messages
from skyloop.messages import codec, command, config
from skyloop.messages.frame import MAX_PIECE
from skyloop.messages.relayed import Shape
from skyloop.transport.base import MAX_PACKET, MAX_SUBSCRIPTIONS, MAX_TOPIC
from skyloop.transport.local import packets
from skyloop.transport.local.frame_exchange import MAX_LEASES

PAGE = (Path(__file__).parents[2] / "docs" / "wire-format.md").read_text()
SECTIONS = re.compile(r"^### (\w+)(?: — kind (\d+))?\n(.*?)(?=^##|\Z)", re.MULTILINE | re.DOTALL)
FOUND = {
    name: (number, body) for name, number, body in SECTIONS.findall(PAGE.partition("\n## The local transport\n")[0])
}
#: The tag and the fields of each body: a line such as ``1  Hello  (name str ≤64, role Role) what it is``.
TAGGED = {
    name: (tag, [field.split()[0] for field in fields.split(",") if field])
    for tag, name, fields in re.findall(r"^ *(\d+)  ([A-Z]\w+)(?: +\(([^)]*)\))?.*$", PAGE, re.MULTILINE)
}
BODIES = (*typing.get_args(config.AnyRequest), *typing.get_args(config.AnyReply), *typing.get_args(Shape))
PARTS = (
    messages.Intrinsics,
    messages.CameraInfo,
    messages.Capabilities,
    messages.Parameter,
    messages.Outcome,
    messages.VehicleOverview,
)
STRUCTS: list[type[msgspec.Struct]] = [*codec.KINDS, *command.ACTION_NAMES, *BODIES, *PARTS]
VOCABULARIES = [v for v in vars(messages).values() if isinstance(v, EnumMeta) and v is not messages.Kind]


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda s: s.__name__)
def test_each_table_lists_the_fields_in_order(struct: type[msgspec.Struct]) -> None:
    tag = struct.__struct_config__.tag
    if tag is not None:
        assert TAGGED[struct.__name__] == (str(tag), list(struct.__struct_fields__))
        return
    number, body = FOUND[struct.__name__]
    rows = re.findall(r"^ *(\d+)  (\w+)  ", body, re.MULTILINE)
    assert rows == [(str(index), field) for index, field in enumerate(struct.__struct_fields__)]
    if struct in codec.KINDS:
        assert number == str(int(codec.KINDS[struct]))


def test_the_page_describes_nothing_else() -> None:
    assert FOUND.keys() | TAGGED.keys() == {struct.__name__ for struct in STRUCTS}
    assert not FOUND.keys() & TAGGED.keys()


@pytest.mark.parametrize("vocabulary", VOCABULARIES, ids=lambda v: v.__name__)
def test_vocabularies_are_complete(vocabulary: type[Enum]) -> None:
    row = re.search(rf"^\| {vocabulary.__name__} \| (.*) \|$", PAGE, re.MULTILINE)
    assert row is not None
    assert re.findall(r"`([\w]+)`", row[1]) == [member.value for member in vocabulary]


def test_sizes_on_the_page() -> None:
    assert f"at most {codec.MAX_BODY:,}".replace(",", " ") in PAGE
    assert codec.SIGNATURE.hex(" ").upper() in PAGE
    assert codec.HEADER_SIZE == 12
    assert re.search(rf"^ 8  data +bin ≤{MAX_PIECE} ", PAGE, re.MULTILINE)


LOCAL, _, FABRIC = PAGE.partition("\n## The local transport\n")[2].partition("\n## The fabric transport\n")
LOCAL_ROWS = {
    int(number, 16): (name, body)
    for number, name, body in re.findall(r"^\| (0x\w+) \| (\w+) \| [^|]+ \| ([^|]+) \|$", LOCAL, re.MULTILINE)
}
WIDTHS = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q"}


def test_the_local_transports_own_kinds_are_complete() -> None:
    assert {number: name for number, (name, _) in LOCAL_ROWS.items()} == {
        int(kind): kind.name.lower() for kind in packets.LocalKind
    }


@pytest.mark.parametrize(
    ("kind", "packet"),
    [
        (packets.LocalKind.HELLO, packets.hello()),
        (packets.LocalKind.RELEASE, packets.release(0x01020304)),
        (packets.LocalKind.SLOT, packets.slot(0x01020304, 0x05060708, 0x1112131415161718)),
        (packets.LocalKind.RETIRE, packets.retire(0x01020304, 0x05060708)),
    ],
    ids=str,
)
def test_the_numbers_of_the_local_packets(kind: packets.LocalKind, packet: bytes) -> None:
    layout = "<" + "".join(WIDTHS[width] for width in re.findall(r"\bu\d+\b", LOCAL_ROWS[kind][1]))
    numbers = struct.unpack(layout, packet[codec.HEADER_SIZE :])
    assert packets.parse(packet) == numbers


def test_a_subscription_and_a_frame_are_built_as_the_page_says() -> None:
    assert packets.subscribe("video/ä", True)[codec.HEADER_SIZE :] == b"\1" + "video/ä".encode()
    header = codec.encode(messages.FrameHeader("front", 1, 2, 3, 4, 5, messages.Encoding.MONO8, 20))
    frame = packets.frame(0x01020304, header)
    assert frame[5] == 0x44
    assert frame[12:] == bytes.fromhex("04030201") + header


def test_numbers_in_the_text_about_the_local_transport() -> None:
    assert f"now {packets.REVISION} |" in LOCAL
    assert f"1 to {MAX_TOPIC} characters" in LOCAL
    assert f"at most {packets.MAX_REASON} bytes" in LOCAL
    assert f"1 to {MAX_PACKET:,} bytes".replace(",", " ") in LOCAL
    assert f"at most {MAX_SUBSCRIPTIONS} subscriptions at a time" in LOCAL
    assert f"at most {MAX_LEASES} leases a camera" in LOCAL
