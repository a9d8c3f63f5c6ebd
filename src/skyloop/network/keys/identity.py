"""Identities on the network: a name, a role, and the drones that the role applies to."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from fnmatch import fnmatchcase
from typing import Final

from skyloop.errors import UsageError

ANYONE: Final = "anyone"  #: name of all applications that have no key, and therefore never a key's name
ALL_DRONES: Final = ("*",)
MAX_PATTERNS: Final = 32
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9_.-]{0,47}")
_PATTERN: Final = re.compile(r"[a-z0-9_.*-]{1,48}")


class KeyRole(StrEnum):
    """What a key permits with respect to its identity's drones."""

    PILOT = "pilot"  #: may see every drone, and fly its own
    OBSERVER = "observer"  #: may see its drones, but not fly any
    PROXY = "proxy"  #: may serve drones with its names
    ROUTER = "router"  #: forwards everyone's sealed traffic between networks; it could drop traffic, but not read it


@dataclass(frozen=True, slots=True)
class Identity:
    """A name and its rights. ``drones`` are patterns in which ``*`` matches any characters."""

    name: str
    role: KeyRole
    drones: tuple[str, ...] = ALL_DRONES

    def covers(self, drone: str) -> bool:
        """Return whether this identity's drones include one with this name."""
        return any(fnmatchcase(drone, pattern) for pattern in self.drones)

    def may_fly(self, drone: str) -> bool:
        """Return whether this is a pilot for a drone with this name."""
        return self.role is KeyRole.PILOT and self.covers(drone)

    def may_see(self, drone: str) -> bool:
        """Return whether an application with these keys may see a drone with this name. A pilot may see all drones."""
        return self.role is KeyRole.PILOT or (self.role is KeyRole.OBSERVER and self.covers(drone))

    def may_serve(self, drone: str) -> bool:
        """Return whether this is a proxy that may serve a drone with this name."""
        return self.role is KeyRole.PROXY and self.covers(drone)

    def require_proxy(self, drone: str) -> None:
        """Check that this is a proxy that may serve a drone with this name."""
        if self.role is not KeyRole.PROXY:
            raise UsageError(f"these are the keys of {self}: a proxy needs keys of --role proxy")
        if not self.covers(drone):
            raise UsageError(f"these are the keys of {self}: they are not for the name {drone!r}")

    def require_router(self) -> None:
        """Check that this is a router."""
        if self.role is not KeyRole.ROUTER:
            raise UsageError(f"these are the keys of {self}: a router needs keys of --role router")

    def require_application(self) -> None:
        """Check that this is a pilot or an observer."""
        if self.role not in (KeyRole.PILOT, KeyRole.OBSERVER):
            raise UsageError(f"these are the keys of {self}: an application needs a pilot's or an observer's")

    def __str__(self) -> str:
        return f"{self.name}, {self.role}" + ("" if self.role is KeyRole.ROUTER else f" of {','.join(self.drones)}")


def make_identity(name: str, role: str, drones: str = "*") -> Identity:
    """Create an identity from user input.

    The name has 1 to 48 lowercase letters, digits, ``_``, ``-`` and ``.``, and is not ``anyone``; ``role`` is a value
    of :class:`KeyRole`; ``drones`` are names or patterns separated by commas, for a router ``*``.
    """
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot be the name of a key: 1 to 48 lower-case letters, digits, '_', '-' and '.', "
            "the first one a letter or a digit"
        )
    if name == ANYONE:
        raise UsageError(f"no key can be named {ANYONE!r}: that is the name of all who have no key")
    if role not in list(KeyRole):
        raise UsageError(f"there is no role {role!r}; there are {', '.join(KeyRole)}")
    patterns = parse_drones(drones)
    if role == KeyRole.ROUTER and patterns != ALL_DRONES:
        raise UsageError("a router carries the traffic of all drones: leave out the drones")
    return Identity(name, KeyRole(role), patterns)


def parse_drones(text: str) -> tuple[str, ...]:
    """Parse drone names or patterns separated by commas: ``alpha,bravo*``."""
    patterns = tuple(dict.fromkeys(re.sub(r"\*+", "*", part.strip()) for part in text.split(",")))
    for pattern in patterns:
        if not _PATTERN.fullmatch(pattern) or not (_NAME.fullmatch(pattern) or "*" in pattern):
            raise UsageError(
                f"{pattern!r} names no drones: lower-case letters, digits, '_', '-' and '.', and '*' for any of these; "
                "several are separated by commas: alpha,bravo*"
            )
    if len(patterns) > MAX_PATTERNS:
        raise UsageError(
            f"{len(patterns)} patterns of drones are too many: give at most {MAX_PATTERNS}, or '*' for any name"
        )
    return ALL_DRONES if "*" in patterns else patterns
