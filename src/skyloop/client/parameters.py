"""Access the parameters of the vehicle and the proxy as a mapping."""

from __future__ import annotations

import numbers
import threading
from collections.abc import Callable, Iterator, Mapping

import msgspec
import numpy as np

from skyloop.client.authority import AuthorityTracker
from skyloop.client.channels import Emit
from skyloop.client.connection import ProxyConnection
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
    Severity,
    Value,
)

ANSWER_S = 2.0  #: time limit for the proxy's answer
MAX_TEXT = 4096  #: maximum number of characters in a string value
MAX_NUMBERS = 256  #: maximum number of elements in a list
_NEED_AUTHORITY = frozenset({Refusal.NO_AUTHORITY, Refusal.FOREIGN_LEASE, Refusal.OBSERVER})


class Restorer:
    """Rewrites parameters after a restart of the proxy, which loses the values that the application set.

    Only lasting values are rewritten, never momentary parameters, and only if no other application can have written
    since. A lost link changes nothing at the proxy, and newer values from other pilots are kept. A proxy numbers its
    leases from 1. A gap between two of our leases means that another application held the authority and may have
    written.
    """

    def __init__(self, connection: ProxyConnection, emit: Emit) -> None:
        self._connection = connection
        self._emit = emit
        self._lock = threading.Lock()
        self._written: dict[str, Value] = {}
        self._run_id = 0
        self._lease = 0  # this application's last lease in this run of the proxy
        self._missed = False  # whether the connection was lost after that lease; events may be missing
        self._lost = False  # whether the proxy has restarted, and lost the values, since they were written

    def written(self, parameter: Parameter) -> None:
        """Record a value written by this application."""
        if not parameter.momentary:
            with self._lock:
                self._written[parameter.name] = parameter.value

    def overwritten(self, name: str) -> None:
        """Record that another application has written the parameter ``name``."""
        with self._lock:
            self._written.pop(name, None)

    def connected(self, run_id: int) -> None:
        """Handle a new connection to the proxy's run ``run_id``."""
        with self._lock:
            self._missed = True
            if run_id != self._run_id:
                self._lost = self._run_id != 0
                self._run_id, self._lease = run_id, 0

    def restore(self, lease: int) -> None:
        """Under a newly granted lease, rewrite the values that a restarted proxy has lost. Does not wait."""
        with self._lock:
            others, self._lease = self._missed and lease != self._lease + 1, lease
            lost, written = self._lost, dict(self._written)
            self._missed = self._lost = False
            if others:
                self._written.clear()
        if lost and others and written:
            names = ", ".join(sorted(written))
            text = f"the proxy restarted and others have flown since: {names} were not restored, set them if needed"
            self._emit(EventKind.PARAMETER_CHANGED, text, Severity.WARNING, reason="others")
        elif lost:
            for name, value in written.items():
                self._connection.ask(SetParameter(name, value, lease), self._restored(name, value), ANSWER_S)

    def _restored(self, name: str, value: Value) -> Callable[[AnyReply | LinkError], None]:
        def done(answer: AnyReply | LinkError) -> None:
            if isinstance(answer, LinkError):
                with self._lock:
                    self._lost = True  # the link was lost again: retry after the next grant
            elif isinstance(answer, Refused):
                text = f"{name} could not be restored to {value!r}: {answer.message}"
                self._emit(EventKind.PARAMETER_CHANGED, text, name=name, reason=answer.code.value)

        return done


class Config(Mapping[str, Value]):
    """Parameters as a mapping from name to value; each access sends a request to the proxy.

    ``drone.config["limits.tilt"]`` reads, ``drone.config["limits.tilt"] = 0.2`` writes. Writing requires the authority.
    A restarted proxy loses written values. They are written again when the authority is next granted, unless another
    application held it in the meantime. Momentary parameters, such as a flip, are never rewritten. Every method waits
    for the proxy's answer and raises :class:`NoAnswerError` if none arrives within 2 s.
    """

    def __init__(self, connection: ProxyConnection, authority: AuthorityTracker, restorer: Restorer) -> None:
        self._connection = connection
        self._authority = authority
        self._restorer = restorer

    def __getitem__(self, name: str) -> Value:
        """Return the current value. Raises :class:`UnknownNameError`, with suggestions, if the name is unknown."""
        return self.describe(name).value

    def __setitem__(self, name: str, value: object) -> None:
        """Write one value.

        Raises:
            ParameterError: If the proxy refuses the value; the message gives the reason.
            AuthorityError: If this application does not hold the authority.
            UnknownNameError: If no parameter has this name; the error suggests similar names.
            UsageError: If no parameter can have a value of this type.
            LinkError: If the link broke before the answer and the parameter is momentary; it may have been executed.
        """
        plain = plain_value(name, value)
        answer = self._call(
            name,
            lambda: SetParameter(_name(name), plain, self._authority.status.lease),
            may_repeat=lambda: not self.describe(name).momentary,
        )
        if not isinstance(answer, ParameterValue):
            raise LinkError(f"the proxy answered a write of {name} with {type(answer).__name__}")
        self._restorer.written(msgspec.structs.replace(answer.parameter, value=plain))

    def describe(self, name: str) -> Parameter:
        """Return a parameter's type, unit, range, default, value and description.

        Raises :class:`UnknownNameError`, with suggestions, if no parameter has this name.
        """
        answer = self._call(name, lambda: GetParameter(_name(name)))
        if not isinstance(answer, ParameterValue):
            raise LinkError(f"the proxy answered a read of {name} with {type(answer).__name__}")
        return answer.parameter

    def parameters(self) -> list[Parameter]:
        """Return all parameters, sorted by name."""
        found: list[Parameter] = []
        while True:
            first = len(found)
            page = self._connection.call(lambda first=first: ListParameters(first), ANSWER_S)  # type: ignore[misc]
            if not isinstance(page, ParameterPage):
                raise LinkError(f"the proxy answered a request for the parameters with {type(page).__name__}")
            found += page.parameters
            if not page.parameters or len(found) >= page.total:
                return found

    def __iter__(self) -> Iterator[str]:
        return iter([parameter.name for parameter in self.parameters()])

    def __len__(self) -> int:
        return len(self.parameters())

    def __contains__(self, name: object) -> bool:
        return any(parameter.name == name for parameter in self.parameters())

    def items(self) -> list[tuple[str, Value]]:  # type: ignore[override]  # one request for all names
        """Return the (name, value) pairs of all parameters, sorted by name."""
        return [(parameter.name, parameter.value) for parameter in self.parameters()]

    def values(self) -> list[Value]:  # type: ignore[override]
        """Return the values of all parameters, sorted by name."""
        return [parameter.value for parameter in self.parameters()]

    def _call(
        self, name: str, body: Callable[[], AnyRequest], may_repeat: Callable[[], bool] = lambda: True
    ) -> AnyReply:
        answer = self._connection.call(body, ANSWER_S, may_repeat=may_repeat)
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
        raise UsageError(f"a parameter's name must be a string of 1 to 128 characters, got {name!r}")
    return name


def plain_value(name: str, value: object) -> Value:
    """Return a value that can be sent: a bool, int, float, str (up to 4096 characters) or tuple of up to 256 floats.

    Lists and arrays of numbers, and NumPy scalars, are converted. Raises :class:`UsageError` for any other type.
    """
    if isinstance(value, np.ndarray) and not value.ndim:
        value = value.item()
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
        f"{name} can't be {value!r:.80}: use a bool, a number, a string of up to {MAX_TEXT} characters or a list of "
        f"up to {MAX_NUMBERS} numbers"
    )
