"""Define the messages of the configuration channel: each typed request gets one typed answer."""

from __future__ import annotations

from typing import Annotated

import msgspec

from skyloop.messages.fields import Count, Name, Refusal, Role, Takeover, TimeNs, Value
from skyloop.messages.frame import CameraInfo
from skyloop.messages.parameter import Parameter, ParameterName
from skyloop.messages.relayed import MAX_CODE, ProcessorName

Priority = Annotated[int, msgspec.Meta(ge=0, le=31)]
LONGEST_TERM_S = 86_400.0  #: longest time for which the authority can be requested: a day
Term = Annotated[float, msgspec.Meta(gt=0, le=LONGEST_TERM_S)]
MAX_REASON = 200  #: maximum length of a holder's reason for declining [characters]
ClockName = Annotated[str, msgspec.Meta(max_length=64)]
Reason = Annotated[str, msgspec.Meta(max_length=MAX_REASON)]

# Priorities of requests for the authority; a lower number is a higher priority.
HIGHEST_PRIORITY = 0
DEFAULT_PRIORITY = 16
LOWEST_PRIORITY = 31


class Capabilities(msgspec.Struct, frozen=True, array_like=True):
    """What a vehicle can do and which cameras it has, known before the driver opens the vehicle."""

    vehicle: str  #: the vehicle's family, e.g. ``sim`` or ``ardrone2``
    actions: frozenset[str] = frozenset()  #: names of actions that the vehicle itself supports; empty: it can't fly
    cameras: tuple[CameraInfo, ...] = ()
    description: str = ""
    why_not: str = ""  #: human-readable reason why the vehicle can't fly
    software: frozenset[str] = frozenset()  #: names of the actions that the proxy's software autopilot adds


# Requests ------------------------------------------------------------------------------------------------------


class Hello(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """First request on a connection."""

    name: Name  #: name of the application, for display
    role: Role = Role.PILOT


class RequestAuthority(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """Request the authority."""

    priority: Priority = DEFAULT_PRIORITY
    queue: bool = True  #: whether to queue if another application holds the authority; if False, the request is refused
    for_s: Term | None = None  #: how long the application needs the authority [s]; nil: until it is released
    takeover: Takeover = Takeover.NOW


class ReleaseAuthority(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """Release the authority, or leave the queue."""


class GetParameter(msgspec.Struct, frozen=True, array_like=True, tag=4):
    """Read a parameter."""

    name: ParameterName


class SetParameter(msgspec.Struct, frozen=True, array_like=True, tag=5):
    """Write a parameter."""

    name: ParameterName
    value: Value
    lease: Count  #: lease of the sender; writing requires the authority


class ListParameters(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """List a page of the parameters, sorted by name."""

    first: Count = 0


class Ping(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """Ask for the proxy's time to estimate the clock offset and check that the proxy is alive."""

    sent_ns: TimeNs  #: time of sending, on the requester's clock


class GetStatistics(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """Ask for the proxy's counters."""


class JoinProcessor(msgspec.Struct, frozen=True, array_like=True, tag=16):
    """Join the workers of a processor, or remain a worker; workers repeat this several times a second.

    The answer is :class:`Done`; a :class:`ProcessorShare` tells the worker which frames it gets.
    """

    processor: ProcessorName
    code: Annotated[str, msgspec.Meta(max_length=MAX_CODE)]  #: identifies the code that all workers of a processor run
    camera: Name
    shared: bool = True  #: whether each frame goes to one worker only, rather than to all workers
    ready: bool = True  #: False: this worker can't take frames now, and other workers get them


class AnswerTakeover(msgspec.Struct, frozen=True, array_like=True, tag=9):
    """Answer of the holder to an application that requests the authority."""

    lease: Count  #: lease of the holder itself
    app_id: Count  #: number of the requesting application
    grant: bool  #: whether to hand over the authority now; False: not yet
    reason: Reason = ""  #: human-readable reason for declining


AnyRequest = (
    Hello
    | RequestAuthority
    | ReleaseAuthority
    | GetParameter
    | SetParameter
    | ListParameters
    | Ping
    | GetStatistics
    | JoinProcessor
    | AnswerTakeover
)


class Request(msgspec.Struct, frozen=True, array_like=True):
    """One request, numbered to identify its reply."""

    id: Count  #: number chosen by the requester; the answer repeats it
    body: AnyRequest


# Answers -------------------------------------------------------------------------------------------------------


class Welcome(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """The answer to ``Hello``."""

    app_id: Count  #: the application's number in this run of the proxy, from 1
    proxy: Name
    run_id: Count  #: random number; a different number means that the proxy has restarted
    pid: Count
    uri: str  #: the vehicle's address
    now_ns: TimeNs  #: current time on the proxy's clock
    capabilities: Capabilities
    clock: ClockName = ""  #: identity of that clock, which is one of the host's monotonic clocks; empty: unknown


class AuthorityGranted(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """The application now holds the authority."""

    lease: Count
    until_ns: TimeNs = 0  #: end of the requested time, on the proxy's clock; 0: unlimited


class AuthorityQueued(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """The request is queued. The grant arrives as an event and appears in feedback (``owner_id``, ``lease``)."""

    position: Count  #: position in the queue; 1 is next
    holder: str
    holder_priority: Priority
    wait_s: float | None = None  #: estimated from the times for which others requested the authority [s]; nil: unknown
    asked: bool = False  #: whether the holder is being asked to hand over the authority


class ParameterValue(msgspec.Struct, frozen=True, array_like=True, tag=4):
    """A parameter's value, either as read or after a write."""

    parameter: Parameter


class ParameterPage(msgspec.Struct, frozen=True, array_like=True, tag=5):
    """A page of the parameters; ``total`` is the number of all parameters, ``first`` the index of its first one."""

    total: Count
    first: Count
    parameters: tuple[Parameter, ...]


class Pong(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """The answer to ``Ping``, with the same ``sent_ns``; ``now_ns`` is the time on the proxy's clock."""

    sent_ns: TimeNs
    now_ns: TimeNs


class Done(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """The request succeeded and has no other result."""


class Refused(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """The request was refused; ``message`` gives the reason in readable form."""

    code: Refusal
    message: str


class Statistics(msgspec.Struct, frozen=True, array_like=True, tag=9):
    """The proxy's counters, by dotted name."""

    counters: dict[str, float]


AnyReply = (
    Welcome | AuthorityGranted | AuthorityQueued | ParameterValue | ParameterPage | Pong | Done | Refused | Statistics
)


class Reply(msgspec.Struct, frozen=True, array_like=True):
    """The answer to one request."""

    id: Count
    body: AnyReply
