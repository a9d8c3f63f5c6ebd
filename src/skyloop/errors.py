"""Every error that Skyloop raises on purpose, in one tree.

::

    SkyloopError
    ├── UsageError (also ValueError)      an argument is wrong: says what was given and what is allowed
    │   ├── UnknownNameError (also KeyError)   no such proxy, camera, parameter …; carries ``suggestions``
    │   ├── FileFormatError               a file cannot be understood; names the file and the place
    │   └── NameTakenError                the name is in use; says by whom
    ├── DecodeError (also ValueError)     received bytes are no valid packet, of Skyloop or a vehicle
    ├── MissingExtraError (also ImportError)   an optional part is not installed; names the ``skyloop install``
    ├── UnsupportedError                  this platform or this vehicle cannot do what was asked
    ├── RefusedError                      the other end understood and refused; carries ``code`` and its reason
    │   ├── AuthorityError                commanding or writing without holding the authority
    │   └── ParameterError                the value is out of range, of the wrong type, or the parameter is read-only
    ├── LinkError                         the other end of a link is not there or stopped answering
    │   ├── NoAnswerError (also TimeoutError)  nothing came within the time given
    │   └── ClosedError                   this end was closed by its own user
    ├── SwarmError                        some drones of a swarm failed; carries the ``errors`` by name
    └── DriverError                       the vehicle's driver failed; carries what the vehicle reported

Leaves say who is at fault and in which phase; catch the branch that you can handle.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from enum import StrEnum
from functools import partial
from typing import Final, Self


def shortened(text: str, most: int) -> str:
    """Return a text of at most ``most`` characters, with its beginning and its end: causes stand at either.

    What can't be sent as UTF-8, as of a file name that is none, becomes a question mark.
    """
    text = text.encode("utf-8", "replace").decode("utf-8")
    if len(text) <= most:
        return text
    ending = (most - 3) // 2
    return f"{text[: most - 3 - ending]} … {text[len(text) - ending :]}"


class Hint(StrEnum):
    """What may be done about an error. ``str(error)`` ends with it in Python's words; the command line has its own."""

    SEARCH_NETWORK = "search the network"
    NAME_NETWORK = "name the network"
    REACH_BY_NETWORK = "reach it over the network"
    OBSERVE = "observe meanwhile"
    FLY = "connect as a pilot"


_IN_PYTHON: Final = {
    Hint.SEARCH_NETWORK: (
        "only this host was searched (network=True, or the variable SKYLOOP_NETWORK, searches further)"
    ),
    Hint.NAME_NETWORK: "give network=True as well, or set SKYLOOP_NETWORK",
    Hint.REACH_BY_NETWORK: "a program may reach it over the network (network=True) from anywhere",
    Hint.OBSERVE: 'connect with access="observe" to watch meanwhile',
    Hint.FLY: 'connect with access="pilot" to fly',
}


class SkyloopError(Exception):
    """Base of all errors that Skyloop raises on purpose.

    Attributes:
        hint: What may be done about it, for programs that word it themselves; None: nothing but what is said.
    """

    hint: Hint | None = None

    def with_hint(self, hint: Hint) -> Self:
        """Add a hint, and return this error."""
        self.hint = hint
        return self

    @property
    def reason(self) -> str:
        """What is wrong, without the hint."""
        return super().__str__()

    def __str__(self) -> str:
        return self.reason if self.hint is None else f"{self.reason}; {_IN_PYTHON[self.hint]}"


class UsageError(SkyloopError, ValueError):
    """Raised when an argument is of the wrong type, not finite, out of range, or otherwise unusable."""


class UnknownNameError(UsageError, KeyError):
    """Raised when nothing of this name exists; ``suggestions`` holds the nearest known names, best first.

    Attributes:
        kind: What was looked up, for example ``camera``.
        name: The name that was given.
        known: All known names, sorted.
        suggestions: Up to three known names that are similar.
        message: The error's text.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], *, where: str = "") -> None:
        """Compose the message, with suggestions from the known names.

        Args:
            kind: What was looked up, for example ``camera``.
            name: The name that was given.
            known: Names that exist.
            where: Where they were looked up, behind the name: ``on the network``.
        """
        choices = sorted(set(known))
        self.kind = kind
        self.name = name
        self.known = choices
        self.where = where
        self.suggestions: list[str] = difflib.get_close_matches(name, choices, n=3, cutoff=0.5)
        if self.suggestions:
            hint = "did you mean " + " or ".join(repr(s) for s in self.suggestions) + "?"
        elif choices:
            shown = ", ".join(choices[:24]) + (", …" if len(choices) > 24 else "")
            hint = f"known: {shown}"
        else:
            hint = "none is known here"
        self.message = f"no {kind} named {name!r}{f' {where}' if where else ''}; {hint}"
        super().__init__(self.message)

    @property
    def reason(self) -> str:  # KeyError would show the repr of the message
        """What is wrong, without the hint."""
        return self.message

    def __reduce__(self) -> tuple[object, ...]:  # errors of worker processes come back pickled
        return partial(type(self), where=self.where), (self.kind, self.name, self.known), {"hint": self.hint}


class FileFormatError(UsageError):
    """Raised when a file cannot be understood; the message names the file and, where known, the place in it."""


class NameTakenError(UsageError):
    """Raised when the name asked for is already in use; the message says by whom."""


class DecodeError(SkyloopError, ValueError):
    """Raised for bytes that are no valid packet, of Skyloop or a vehicle.

    Signature, version, kind, length or range is wrong.
    """


def install_command(*extras: str) -> str:
    """Return the command that installs optional parts, in a checkout as from a wheel.

    Args:
        extras: Their names.
    """
    return f"skyloop install {' '.join(extras)}"


class MissingExtraError(SkyloopError, ImportError):
    """Raised when an optional part of Skyloop is not installed; ``extra`` is its name for ``skyloop install``."""

    def __init__(self, what: str, extra: str, *, cause: str = "") -> None:
        """Compose the message.

        Args:
            what: What needs the optional part.
            extra: Name of the extra, as ``skyloop install`` takes it.
            cause: Why the import failed, if known.
        """
        self.what = what
        self.extra = extra
        self.cause = cause
        detail = f" ({cause})" if cause else ""
        super().__init__(f"{what} needs an optional part that is not installed{detail}: {install_command(extra)}")

    def __reduce__(self) -> tuple[object, ...]:
        return partial(type(self), cause=self.cause), (self.what, self.extra)


class UnsupportedError(SkyloopError):
    """Raised when this platform or this vehicle cannot do what was asked; the message says what is possible instead."""


class RefusedError(SkyloopError):
    """Raised when the other end understood the request and refused it.

    ``code`` is the value of a :class:`skyloop.messages.Refusal`, or one of the client's own such as ``"busy"``.
    """

    def __init__(self, message: str, *, code: str = "refused") -> None:
        super().__init__(message)
        self.code = code


class AuthorityError(RefusedError):
    """Raised when a vehicle is commanded, or a parameter written, without holding the authority over it."""


class ParameterError(RefusedError):
    """Raised when a parameter was not written: the value is out of range or of the wrong type, or it is read-only."""


class LinkError(SkyloopError):
    """Raised when the other end of a link is not there, refuses the connection, or goes away."""


class NoAnswerError(LinkError, TimeoutError):
    """Raised when nothing comes within the time given."""


class ClosedError(LinkError):
    """Raised when an object is used that its own user has closed."""


class SwarmError(SkyloopError):
    """Raised when something fails at some drones of a swarm; the message names each of them on a line of its own.

    Attributes:
        errors: What failed, by name of the drone.
        total: Number of drones in the swarm.
    """

    def __init__(self, what: str, errors: Mapping[str, Exception], total: int) -> None:
        """Compose the message.

        Args:
            what: What the drones failed at.
            errors: Why, by name of the drone.
            total: Number of drones in the swarm.
        """
        self.errors = dict(errors)
        self.total = total
        self._what = what
        lines = "".join(f"\n  {name}: {type(error).__name__}: {error}" for name, error in self.errors.items())
        super().__init__(f"{what} failed for {len(self.errors)} of {total} drones:{lines}")

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._what, self.errors, self.total)


class DriverError(SkyloopError):
    """Raised when a vehicle's driver fails or the vehicle refuses."""
