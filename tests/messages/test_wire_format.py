"""``docs/wire-format.md`` is true of the code: every table, tag, kind and vocabulary."""

from __future__ import annotations

import re
import typing
from enum import EnumMeta
from pathlib import Path

import msgspec
import pytest

from skyloop import messages
from skyloop.messages import annotation, codec, command, config

PAGE = (Path(__file__).parents[2] / "docs" / "wire-format.md").read_text()
SECTIONS = re.compile(r"^### (\w+)(?: — (kind|tag) (\d+))?\n(.*?)(?=^##|\Z)", re.MULTILINE | re.DOTALL)
FOUND = {name: (word, number, body) for name, word, number, body in SECTIONS.findall(PAGE)}
BODIES = (*typing.get_args(config.AnyRequest), *typing.get_args(config.AnyReply), *typing.get_args(annotation.Shape))
PARTS = (messages.Intrinsics, messages.CameraInfo, messages.Capabilities, messages.Parameter)
STRUCTS: list[type[msgspec.Struct]] = [*codec.KINDS, *command.ACTION_NAMES, *BODIES, *PARTS]
VOCABULARIES = [v for v in vars(messages).values() if isinstance(v, EnumMeta) and v is not messages.Kind]


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda s: s.__name__)
def test_each_table_lists_the_fields_in_order(struct: type[msgspec.Struct]) -> None:
    word, number, body = FOUND[struct.__name__]
    tag = struct.__struct_config__.tag
    first = 0 if tag is None else 1
    rows = re.findall(r"^\| (\d+) \| `(\w+)` \|", body, re.MULTILINE)
    assert rows == [(str(index + first), field) for index, field in enumerate(struct.__struct_fields__)]
    if tag is not None:
        assert (word, number) == ("tag", str(tag))
    elif struct in codec.KINDS:
        assert (word, number) == ("kind", str(int(codec.KINDS[struct])))


def test_the_page_describes_nothing_else() -> None:
    assert set(FOUND) == {struct.__name__ for struct in STRUCTS}


@pytest.mark.parametrize("vocabulary", VOCABULARIES, ids=lambda v: v.__name__)
def test_vocabularies_are_complete(vocabulary: EnumMeta) -> None:
    row = re.search(rf"^\| {vocabulary.__name__} \| (.*) \|$", PAGE, re.MULTILINE)
    assert row is not None
    assert re.findall(r"`([\w]+)`", row[1]) == [member.value for member in vocabulary]  # type: ignore[attr-defined]


def test_sizes_on_the_page() -> None:
    assert f"at most {codec.MAX_BODY:,}".replace(",", " ") in PAGE
    assert codec.SIGNATURE.hex(" ").upper() in PAGE
    assert codec.HEADER_SIZE == 12
