"""The page on the wire format matches the fabric transport."""

from __future__ import annotations

import re

import msgspec
import pytest

from skyloop.network import config, delivery, frames, layout, packets, registry, sealing
from skyloop.transport.base import MAX_TOPIC
from tests.support.pages import ROOT
from tests.support.samples import PACKETS

FABRIC = (ROOT / "docs" / "wire-format.md").read_text().partition("\n## The fabric transport\n")[2]
GOLDEN: dict[str, packets.Message] = {
    "subscribe": packets.Subscribe("video/front?encoding=jpeg&quality=80", True),
    "taken": packets.Taken("feedback", 9),
    "seen": packets.Seen("video/front", 1000),
    "bye": packets.Bye("closed by the application"),
    "key": packets.Key(2, bytes(range(32))),
}


def test_the_keys() -> None:
    names = ("NAME", "WHO", "ID")
    told = set(re.findall(r"^\| `(skyloop/1/[^`]+)` \|", FABRIC, re.MULTILINE))
    assert told == {
        layout.alive("NAME", "RUN"),
        layout.info("NAME"),
        layout.app(*names),
        layout.join(*names),
        *(layout.upward(way, *names) for way in (layout.ASK, layout.ORDER, layout.COMMAND)),
        layout.to("NAME", "ID"),
        layout.topic("NAME", "TOPIC"),
        layout.video("NAME", "CAMERA", "VARIANT"),
        layout.video_for("NAME", "CAMERA", "VARIANT", "ID"),
    }


def test_the_transports_own_kinds_are_complete() -> None:
    rows = {int(number, 16): name for number, name in re.findall(r"^\| (0x\w+) \| (\w+) \|", FABRIC, re.MULTILINE)}
    assert rows == {int(kind): kind.name.lower() for kind in packets.FabricKind}


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_packets(name: str) -> None:
    packet = (PACKETS / "fabric" / f"{name}.bin").read_bytes()
    assert packets.parse(packet) == GOLDEN[name]
    assert {path.stem for path in (PACKETS / "fabric").glob("*.bin")} == set(GOLDEN)


def test_the_packet_shown_byte_by_byte() -> None:
    rows = re.findall(r"^\| \d+ \| \d+ \| `([0-9A-F ]+)` \|$", FABRIC, re.MULTILINE)
    assert bytes.fromhex("".join(rows)) == packets.taken("feedback", 9)


def test_the_fields_of_the_first_packets() -> None:
    for struct in (packets.Join, packets.Welcome, packets.ProxyInfo):
        (row,) = re.findall(rf"^\| {struct.__name__} \| (.*) \|$", FABRIC, re.MULTILINE)
        assert re.findall(r"`(\w+)`", row) == [field.name for field in msgspec.structs.fields(struct)]


def test_numbers_in_the_text() -> None:
    text = " ".join(FABRIC.split())  # wherever its lines are wrapped
    assert f"`revision` uint, now {packets.REVISION}" in text
    assert f"1 to {MAX_TOPIC} characters" in text
    assert f"at most {packets.MAX_REASON} bytes" in text
    assert f"Lease {config.LEASE_S * 1000:g} ms" in text
    assert f"seen within {registry.CONFIRM_S:g} s" in text
    assert f"at most {delivery.DEPTH} packets or {delivery.MAX_BYTES >> 20} MiB" in text
    assert f"every {delivery.ACKNOWLEDGE_AFTER} packets" in text
    assert f"At most {frames.WINDOW} frames of a request" in text
    assert f"A frame not acknowledged for {frames.LOST_NS / 1e9:g} s" in text
    assert f"longer by {sealing.TRAILER} bytes" in text
    assert f"{sealing.TAG} bytes longer" in text
    assert f"more than {sealing.WIDTH} numbers behind" in text
    assert f"uses it {sealing.SWITCH_S:g} s later" in text
