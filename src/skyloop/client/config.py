"""The vehicle's and the proxy's parameters, as a mapping."""

from __future__ import annotations

import numbers
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from skyloop.errors import AuthorityError, LinkError, ParameterError, RefusedError, UnknownNameError, UsageError
from skyloop.messages import (
    AnyReply,
    AnyRequest,
    EventKind,
    GetParameter,
    ListParameters,
    Parameter,
    ParameterPage,
    ParameterValue,
    Refusal,
    Refused,
    SetParameter,
    Value,
)

if TYPE_CHECKING:
    from skyloop.client.delivery import Tell
    from skyloop.client.link import Link

ANSWER_S = 2.0
MAX_TEXT = 4096  #: characters
MAX_NUMBERS = 256
_NEED_AUTHORITY = frozenset({Refusal.NO_AUTHORITY, Refusal.FOREIGN_LEASE, Refusal.OBSERVER})


class Config(Mapping[str, Value]):
    """``drone.config["limits.tilt"]`` reads, ``drone.config["limits.tilt"] = 0.2`` writes, one transaction each.

    Writing needs the authority. What was written is written again when the proxy was lost, is back, and has given
    this application the authority again. Every method asks the proxy, and may raise :class:`NoAnswerError`.
    """

    def __init__(self, link: Link, lease: Callable[[], int], tell: Tell) -> None:
        self._link = link
        self._lease = lease
        self._tell = tell
        self._lock = threading.Lock()
        self._written: dict[str, Value] = {}
        self._restore = False  #: the connection on which they were written is gone

    def __getitem__(self, name: str) -> Value:
        """The present value. Raises :class:`UnknownNameError`, with suggestions."""
        return self.describe(name).value

    def __setitem__(self, name: str, value: object) -> None:
        """Write one value. Raises :class:`ParameterError` with the proxy's reason, :class:`AuthorityError`,
        :class:`UnknownNameError`, or :class:`UsageError` for a value of no usable type."""
        plain = plain_value(name, value)
        answer = self._call(name, lambda: SetParameter(_name(name), plain, self._lease()))
        if not isinstance(answer, ParameterValue):
            raise LinkError(f"the proxy answered the writing of {name} with {type(answer).__name__}")
        with self._lock:
            self._written[name] = plain

    def describe(self, name: str) -> Parameter:
        """All that is known of a parameter: type, unit, range, default, value, description."""
        answer = self._call(name, lambda: GetParameter(_name(name)))
        if not isinstance(answer, ParameterValue):
            raise LinkError(f"the proxy answered the reading of {name} with {type(answer).__name__}")
        return answer.parameter

    def parameters(self) -> list[Parameter]:
        """All parameters, sorted by name."""
        found: list[Parameter] = []
        while True:
            first = len(found)
            page = self._link.call(lambda first=first: ListParameters(first), ANSWER_S)  # type: ignore[misc]
            if not isinstance(page, ParameterPage):
                raise LinkError(f"the proxy answered the list of parameters with {type(page).__name__}")
            found += page.parameters
            if not page.parameters or len(found) >= page.total:
                return found

    def __iter__(self) -> Iterator[str]:
        return iter([parameter.name for parameter in self.parameters()])

    def __len__(self) -> int:
        return len(self.parameters())

    def __contains__(self, name: object) -> bool:
        return any(parameter.name == name for parameter in self.parameters())

    def items(self) -> list[tuple[str, Value]]:  # type: ignore[override]  # one question, not one for each name
        """(name, value) of all parameters, sorted by name."""
        return [(parameter.name, parameter.value) for parameter in self.parameters()]

    def values(self) -> list[Value]:  # type: ignore[override]
        """The values of all parameters, sorted by name."""
        return [parameter.value for parameter in self.parameters()]

    # For the drone ---------------------------------------------------------------------------------------------

    def disconnected(self) -> None:
        """The proxy may have forgotten what was written."""
        self._restore = True

    def granted(self, lease: int) -> None:
        """The authority is (again) held: write once more what a lost connection may have undone. Does not wait."""
        if not self._restore:
            return
        self._restore = False
        with self._lock:
            written = dict(self._written)
        for name, value in written.items():
            self._link.ask(SetParameter(name, value, lease), self._restored(name, value), ANSWER_S)

    def _restored(self, name: str, value: Value) -> Callable[[AnyReply | LinkError], None]:
        def done(answer: AnyReply | LinkError) -> None:
            if isinstance(answer, LinkError):
                self._restore = True  # lost again: with the next grant
            elif isinstance(answer, Refused):
                text = f"{name} could not be set to {value!r} again: {answer.message}"
                self._tell(EventKind.PARAMETER_CHANGED, text, name=name, reason=answer.code.value)

        return done

    def _call(self, name: str, body: Callable[[], AnyRequest]) -> AnyReply:
        answer = self._link.call(body, ANSWER_S)
        if not isinstance(answer, Refused):
            return answer
        if answer.code is Refusal.UNKNOWN_PARAMETER:
            raise UnknownNameError("parameter", name, (known.name for known in self.parameters()))
        if answer.code in _NEED_AUTHORITY:
            raise AuthorityError(f"writing {name} needs the authority: {answer.message}", code=answer.code.value)
        kind = ParameterError if answer.code is not Refusal.PROTOCOL else RefusedError
        words = answer.message if answer.message.startswith(name) else f"{name}: {answer.message}"
        raise kind(words, code=answer.code.value)


def _name(name: object) -> str:
    if not isinstance(name, str) or not 1 <= len(name) <= 128:
        raise UsageError(f"a parameter's name is a text of 1 to 128 characters, not {name!r}")
    return name


def plain_value(name: str, value: object) -> Value:
    """A value that can travel: bool, int, float, str or a tuple of floats, from those and their NumPy kin."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, str) and len(value) <= MAX_TEXT:
        return str(value)
    if isinstance(value, numbers.Integral) and -(2**63) <= int(value) < 2**63:
        return int(value)
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return float(value)
    if isinstance(value, list | tuple | np.ndarray) and len(value) <= MAX_NUMBERS:
        many = tuple(value)
        if all(isinstance(one, numbers.Real) for one in many):
            return tuple(float(one) for one in many)
    raise UsageError(
        f"{name} can't be {value!r:.80}: a bool, a number, a text (up to {MAX_TEXT} characters) or a list of up to "
        f"{MAX_NUMBERS} numbers is needed"
    )
