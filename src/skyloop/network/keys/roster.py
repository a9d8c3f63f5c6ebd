"""The roster: every identity of a lab, signed by its authority.

Zenoh's access control knows subjects by their common names, so all names must be known where it is enforced. The
roster is a file of two parts: the list itself, and the signature of exactly those bytes. Its number grows with each
change, and the highest one is in force.
"""

from __future__ import annotations

import base64
import binascii
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import msgspec

from skyloop.errors import FileFormatError, UsageError
from skyloop.network.keys.certificates import Authority
from skyloop.network.keys.identity import Identity, KeyRole

FORMAT: Final = 1
_PURPOSE: Final = b"skyloop roster\n"  # what is signed begins with it: no signature of anything else fits


class Entry(msgspec.Struct, frozen=True):
    """One identity. Times are whole seconds since 1970, UTC."""

    name: str
    role: KeyRole
    drones: tuple[str, ...]
    serial: str  #: of the newest certificate, hexadecimal
    expires: int  #: when that one does
    last: int  #: when the last of all certificates under this name does
    revoked: bool = False

    @property
    def identity(self) -> Identity:
        """The identity itself."""
        return Identity(self.name, self.role, self.drones)

    @property
    def expires_at(self) -> datetime:
        """When its newest certificate expires, in UTC."""
        return datetime.fromtimestamp(self.expires, UTC)

    @property
    def last_at(self) -> datetime:
        """When the last of all certificates under this name expires, in UTC."""
        return datetime.fromtimestamp(self.last, UTC)


class Roster(msgspec.Struct, frozen=True):
    """All identities, by name."""

    number: int
    lab: str  #: the authority's name
    entries: tuple[Entry, ...] = ()
    format: int = FORMAT

    def find(self, name: str) -> Entry | None:
        """Return the entry of a name, None if there is none."""
        return next((entry for entry in self.entries if entry.name == name), None)

    @property
    def identities(self) -> list[Identity]:
        """The identities that may join: all that were not revoked.

        The handshake checks that their certificates are valid.
        """
        return [entry.identity for entry in self.entries if not entry.revoked]

    def put(self, entry: Entry) -> Roster:
        """Return the next roster, with this entry in the place of the one of its name."""
        others = [other for other in self.entries if other.name != entry.name]
        entries = tuple(sorted([*others, entry], key=lambda each: each.name))
        return Roster(self.number + 1, self.lab, entries)


class _File(msgspec.Struct):
    roster: msgspec.Raw
    signature: str


def encode(roster: Roster, authority: Authority) -> bytes:
    """Return the roster's file, signed."""
    body = msgspec.json.format(msgspec.json.encode(roster), indent=1)
    signature = base64.b64encode(authority.sign(_PURPOSE + body)).decode()
    return msgspec.json.encode(_File(msgspec.Raw(body), signature)) + b"\n"


def decode(content: bytes, authority: Authority, path: Path) -> Roster:
    """Check the signature of a roster's file, then decode it.

    Args:
        content: The file.
        authority: The lab's.
        path: The file, for errors.

    Raises:
        FileFormatError: It is not a roster, is damaged, or has another format.
        UsageError: It was changed, or another authority signed it.
    """
    try:
        file = msgspec.json.decode(content, type=_File)
        signature = base64.b64decode(file.signature, validate=True)
    except (msgspec.MsgspecError, UnicodeDecodeError, binascii.Error, RecursionError) as error:
        raise FileFormatError(f"{path} is no roster, or it is damaged: {error}") from None
    body = bytes(file.roster)
    if not authority.signed(_PURPOSE + body, signature):
        raise UsageError(f"the roster {path} was changed, or is not signed by {authority.name}: copy it again")
    try:
        roster = msgspec.json.decode(body, type=Roster)
    except msgspec.MsgspecError as error:
        raise FileFormatError(f"{path} is a roster of another version of Skyloop: {error}") from None
    if roster.format != FORMAT:
        raise FileFormatError(f"{path} is a roster of format {roster.format}; this version of Skyloop reads {FORMAT}")
    return roster
