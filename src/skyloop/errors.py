"""Every error that Skyloop raises on purpose, in one tree.

::

    SkyloopError
    ├── UsageError (also ValueError)      the caller's argument is wrong: says what was given and what would be right
    │   ├── UnknownNameError (also KeyError)   no such proxy, camera, parameter …; carries ``suggestions``
    │   ├── FileFormatError               a file cannot be understood; names the file and the place
    │   └── NameTakenError                the name asked for is in use; says by whom
    ├── DecodeError (also ValueError)     bytes from elsewhere are no Skyloop packet, or not what a vehicle sends
    ├── MissingExtraError (also ImportError)   an optional part is not installed; names the ``pip install``
    ├── UnsupportedError                  this platform or this vehicle cannot do what was asked
    ├── RefusedError                      the other end understood and said no; carries ``code`` and its reason
    │   ├── AuthorityError                commanding or writing without holding the authority
    │   └── ParameterError                the value is out of range, of the wrong type, or the parameter is read-only
    ├── LinkError                         an end of a link is not there or stopped answering
    │   ├── NoAnswerError (also TimeoutError)  nothing came within the time given
    │   └── ClosedError                   this end was closed by its own user
    ├── SwarmError                        some drones of a swarm failed; carries the ``errors`` by name
    └── DriverError                       the vehicle's driver failed; carries what the vehicle said

Leaves say who is at fault and in which phase; catch the branch that you can do something about.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping


class SkyloopError(Exception):
    """Base of all errors raised on purpose by Skyloop."""


class UsageError(SkyloopError, ValueError):
    """An argument is of the wrong type, not finite, out of range, or otherwise unusable."""


class UnknownNameError(UsageError, KeyError):
    """A name that nothing here answers to. ``suggestions`` holds the nearest known names, best first."""

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        choices = sorted(set(known))
        self.kind = kind
        self.name = name
        self.known = choices
        self.suggestions: list[str] = difflib.get_close_matches(name, choices, n=3, cutoff=0.5)
        if self.suggestions:
            hint = "did you mean " + " or ".join(repr(s) for s in self.suggestions) + "?"
        elif choices:
            shown = ", ".join(choices[:24]) + (", …" if len(choices) > 24 else "")
            hint = f"known: {shown}"
        else:
            hint = "none is known here"
        self.message = f"no {kind} named {name!r}; {hint}"
        super().__init__(self.message)

    def __str__(self) -> str:  # KeyError would show the repr of the message
        return self.message


class FileFormatError(UsageError):
    """A file cannot be understood. The message names the file and, where known, the place in it."""


class NameTakenError(UsageError):
    """The name asked for is already in use on this host."""


class DecodeError(SkyloopError, ValueError):
    """Bytes that are no valid packet, of Skyloop or a vehicle: wrong signature, version, kind, length or range."""


class MissingExtraError(SkyloopError, ImportError):
    """An optional part of Skyloop is not installed."""

    def __init__(self, what: str, extra: str, *, cause: str = "") -> None:
        self.extra = extra
        detail = f" ({cause})" if cause else ""
        super().__init__(f"{what} needs an optional part that is not installed{detail}: pip install 'skyloop[{extra}]'")


class UnsupportedError(SkyloopError):
    """This platform or this vehicle cannot do what was asked; the message says what can be done instead."""


class RefusedError(SkyloopError):
    """The other end understood the request and refused it. ``code`` is one of :class:`skyloop.messages.Refusal`."""

    def __init__(self, message: str, *, code: str = "refused") -> None:
        super().__init__(message)
        self.code = code


class AuthorityError(RefusedError):
    """Commanding a vehicle, or writing a parameter, without holding the authority over it."""


class ParameterError(RefusedError):
    """A parameter was not written: unknown range, type, or read-only."""


class LinkError(SkyloopError):
    """The other end of a link is not there, refused the connection, or went away."""


class NoAnswerError(LinkError, TimeoutError):
    """Nothing came within the time given."""


class ClosedError(LinkError):
    """The object was closed by its own user and can't be used any more."""


class SwarmError(SkyloopError):
    """Something went wrong at some drones of a swarm. ``errors`` has what, by the drones' names; ``total`` of how many.

    The message names all of them, one a line.
    """

    def __init__(self, what: str, errors: Mapping[str, Exception], total: int) -> None:
        self.errors = dict(errors)
        self.total = total
        lines = "".join(f"\n  {name}: {type(error).__name__}: {error}" for name, error in self.errors.items())
        super().__init__(f"{what} failed for {len(self.errors)} of {total} drones:{lines}")


class DriverError(SkyloopError):
    """A vehicle's driver failed or the vehicle refused."""
