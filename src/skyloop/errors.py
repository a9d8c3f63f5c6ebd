"""Define all errors that Skyloop raises on purpose, in one hierarchy.

::

    SkyloopError
    ├── UsageError (also ValueError)      an argument is wrong: names the value and the allowed ones
    │   ├── UnknownNameError (also KeyError)   no such proxy, camera, parameter …; carries ``suggestions``
    │   ├── FileFormatError               a file cannot be parsed; names the file and the place
    │   └── NameTakenError                the name is in use; names the user
    ├── DecodeError (also ValueError)     received bytes are not a valid packet, of Skyloop or a vehicle
    ├── MissingExtraError (also ImportError)   an optional part is not installed; names the ``skyloop install``
    ├── UnsupportedError                  not possible on this platform or with this vehicle
    ├── RefusedError                      the other end understood and refused; carries ``code`` and its reason
    │   ├── AuthorityError                commanding or writing without holding the authority
    │   └── ParameterError                the value is out of range, of the wrong type, or the parameter is read-only
    ├── LinkError                         the other end of a link is absent or stopped answering
    │   ├── NoAnswerError (also TimeoutError)  no answer within the given time
    │   └── ClosedError                   this end was closed by its own user
    ├── SwarmError                        some drones of a swarm failed; carries ``errors`` by name
    └── DriverError                       the vehicle's driver failed; carries what the vehicle reported

The leaves name the cause and the phase; catch the branch that covers all errors that you can handle.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from enum import StrEnum
from functools import partial
from typing import Final, Self


def shortened(text: str, most: int) -> str:
    """Shorten text to ``most`` characters; keep its beginning and end, because either may contain the cause.

    Characters that can't be encoded as UTF-8, for example in invalid file names, become question marks.
    """
    text = text.encode("utf-8", "replace").decode("utf-8")
    if len(text) <= most:
        return text
    ending = (most - 3) // 2
    return f"{text[: most - 3 - ending]} … {text[len(text) - ending :]}"


class Hint(StrEnum):
    """A possible remedy for an error. ``str(error)`` ends with it, worded for Python; the CLI words it differently."""

    SEARCH_NETWORK = "search the network"
    NAME_NETWORK = "name the network"
    REACH_BY_NETWORK = "reach it over the network"
    OBSERVE = "observe meanwhile"
    FLY = "connect as a pilot"


_IN_PYTHON: Final = {
    Hint.SEARCH_NETWORK: "only this host was searched (use network=True, or set SKYLOOP_NETWORK, to search further)",
    Hint.NAME_NETWORK: "also give network=True, or set SKYLOOP_NETWORK",
    Hint.REACH_BY_NETWORK: "programs may reach it over the network (network=True)",
    Hint.OBSERVE: 'connect with access="observe" to watch meanwhile',
    Hint.FLY: 'connect with access="pilot" to fly',
}


class SkyloopError(Exception):
    """Base class of all errors that Skyloop raises on purpose."""

    hint: Hint | None = None  #: a possible remedy, for programs that word it themselves; None: the message is complete

    def with_hint(self, hint: Hint) -> Self:
        """Add a hint and return this error."""
        self.hint = hint
        return self

    @property
    def reason(self) -> str:
        """The message without the hint."""
        return super().__str__()

    def __str__(self) -> str:
        return self.reason if self.hint is None else f"{self.reason}; {_IN_PYTHON[self.hint]}"


class UsageError(SkyloopError, ValueError):
    """Raised when an argument has the wrong type, is not finite or out of range, or is otherwise unusable."""


class UnknownNameError(UsageError, KeyError):
    """Raised when a name is unknown; ``suggestions`` lists the most similar known names, best first."""

    def __init__(self, kind: str, name: str, known: Iterable[str], *, where: str = "") -> None:
        """Compose the message, including suggestions; ``where`` follows the name, as in ``on the network``."""
        choices = sorted(set(known))
        self.kind = kind  #: what the name denotes, for example ``camera``
        self.name = name  #: the name that was given
        self.known = choices  #: all known names, sorted
        self.where = where
        #: Up to three known names that are similar.
        self.suggestions: list[str] = difflib.get_close_matches(name, choices, n=3, cutoff=0.5)
        if self.suggestions:
            hint = "did you mean " + " or ".join(repr(s) for s in self.suggestions) + "?"
        elif choices:
            shown = ", ".join(choices[:24]) + (", …" if len(choices) > 24 else "")
            hint = f"known: {shown}"
        else:
            hint = "none is known here"
        #: The error message.
        self.message = f"no {kind} named {name!r}{f' {where}' if where else ''}; {hint}"
        super().__init__(self.message)

    @property
    def reason(self) -> str:  # KeyError would return the repr of the message
        """The message without the hint."""
        return self.message

    def __reduce__(self) -> tuple[object, ...]:  # worker processes pickle their errors
        return partial(type(self), where=self.where), (self.kind, self.name, self.known), {"hint": self.hint}


class FileFormatError(UsageError):
    """Raised when a file cannot be parsed; the message names the file and, if known, the place in it."""


class NameTakenError(UsageError):
    """Raised when the requested name is already in use; the message says what is using it."""


class DecodeError(SkyloopError, ValueError):
    """Raised when bytes are not a valid packet of Skyloop or of a vehicle.

    The signature, version, kind, length or a value is wrong.
    """


def install_command(*extras: str) -> str:
    """Return the command that installs the named optional parts, either in a checkout or for an installed wheel."""
    return f"skyloop install {' '.join(extras)}"


class MissingExtraError(SkyloopError, ImportError):
    """Raised when an optional part of Skyloop is not installed; ``extra`` is its name for ``skyloop install``.

    ``what`` is the feature that needs it; ``cause`` is why the import failed, if known.
    """

    def __init__(self, what: str, extra: str, *, cause: str = "") -> None:
        self.what = what
        self.extra = extra
        self.cause = cause
        detail = f" ({cause})" if cause else ""
        super().__init__(f"{what} needs an optional part that is not installed{detail}: {install_command(extra)}")

    def __reduce__(self) -> tuple[object, ...]:
        return partial(type(self), cause=self.cause), (self.what, self.extra)


class UnsupportedError(SkyloopError):
    """Raised when this platform or vehicle does not support a request; the message names the alternatives."""


class RefusedError(SkyloopError):
    """Raised when the other end understood a request but refused it.

    ``code`` is the value of a :class:`skyloop.messages.Refusal`, or one of the client's own codes, such as ``"busy"``.
    """

    def __init__(self, message: str, *, code: str = "refused") -> None:
        super().__init__(message)
        self.code = code


class AuthorityError(RefusedError):
    """Raised when a vehicle is commanded or a parameter is written without holding the authority over the vehicle."""


class ParameterError(RefusedError):
    """Raised when a parameter can't be written: it is read-only, or the value has the wrong type or is out of range."""


class LinkError(SkyloopError):
    """Raised when the other end of a link is absent, refuses the connection, or disappears."""


class NoAnswerError(LinkError, TimeoutError):
    """Raised when no answer arrives within the given time."""


class ClosedError(LinkError):
    """Raised when the application uses an object that it has closed."""


class SwarmError(SkyloopError):
    """Raised when an action fails for some drones of a swarm; the message has one line per drone."""

    def __init__(self, what: str, errors: Mapping[str, Exception], total: int) -> None:
        """Compose the message; ``what`` is the name of the failed action."""
        self.errors = dict(errors)  #: exceptions, by drone name
        self.total = total  #: number of drones in the swarm
        self._what = what
        lines = "".join(f"\n  {name}: {type(error).__name__}: {error}" for name, error in self.errors.items())
        super().__init__(f"{what} failed for {len(self.errors)} of {total} drones:{lines}")

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self._what, self.errors, self.total)


class DriverError(SkyloopError):
    """Raised when a vehicle's driver fails, or when the vehicle refuses a request."""
