"""The configuration channel: one typed request, one typed answer, in one transaction."""

from __future__ import annotations

from typing import Annotated

import msgspec

from skyloop.messages.fields import Count, Name, Refusal, Role, Takeover, TimeNs, Value
from skyloop.messages.frame import CameraInfo
from skyloop.messages.parameter import Parameter, ParameterName
from skyloop.messages.relayed import MAX_CODE, ProcessorName

Priority = Annotated[int, msgspec.Meta(ge=0, le=31)]
LONGEST_TERM_S = 86_400.0
Term = Annotated[float, msgspec.Meta(gt=0, le=LONGEST_TERM_S)]
MAX_REASON = 200  #: characters of why a holder declines
ClockName = Annotated[str, msgspec.Meta(max_length=64)]
Reason = Annotated[str, msgspec.Meta(max_length=MAX_REASON)]

HIGHEST_PRIORITY = 0
DEFAULT_PRIORITY = 16
LOWEST_PRIORITY = 31


class Capabilities(msgspec.Struct, frozen=True, array_like=True):
    """What a vehicle can do, known before it is opened."""

    vehicle: str  #: the family, e.g. ``sim`` or ``ardrone2``
    actions: frozenset[str] = frozenset()  #: names of the actions that the vehicle itself takes; empty: can't fly
    cameras: tuple[CameraInfo, ...] = ()
    description: str = ""
    why_not: str = ""  #: for a vehicle that can't fly: why, in words for a person
    software: frozenset[str] = frozenset()  #: names of the actions that the proxy's software autopilot adds


# Requests ------------------------------------------------------------------------------------------------------


class Hello(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """First request on a connection."""

    name: Name  #: of the application, for people
    role: Role = Role.PILOT


class RequestAuthority(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """Asks for the authority."""

    priority: Priority = DEFAULT_PRIORITY
    queue: bool = True  #: wait in the queue when another application holds it; else be refused at once
    for_s: Term | None = None  #: for how long it is wanted, from the grant on; nil: until it is given back
    takeover: Takeover = Takeover.NOW


class ReleaseAuthority(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """Give the authority back, or leave the queue."""


class GetParameter(msgspec.Struct, frozen=True, array_like=True, tag=4):
    """Asks for a parameter."""

    name: ParameterName


class SetParameter(msgspec.Struct, frozen=True, array_like=True, tag=5):
    """Writes a parameter."""

    name: ParameterName
    value: Value
    lease: Count  #: writing needs the authority


class ListParameters(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """A page of the parameters, sorted by name."""

    first: Count = 0


class Ping(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """Asks for the proxy's time, to estimate the offset between the clocks and to see that it lives."""

    sent_ns: TimeNs  #: on the asker's clock


class GetStatistics(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """Asks for the proxy's counters."""


class JoinProcessor(msgspec.Struct, frozen=True, array_like=True, tag=16):
    """Be a worker of a processor, or go on being one: asked again some times a second for as long as it works.

    Answered by :class:`Done`; the worker's share of the frames comes as a :class:`ProcessorShare`.
    """

    processor: ProcessorName
    code: Annotated[str, msgspec.Meta(max_length=MAX_CODE)]  #: of all workers of a processor the same
    camera: Name
    shared: bool = True  #: each frame to one worker; else all get all
    ready: bool = True  #: False: frames are for others to take, for this one can't just now


class AnswerTakeover(msgspec.Struct, frozen=True, array_like=True, tag=9):
    """The holder's answer to an application that asks for the authority."""

    lease: Count  #: the holder's own
    app_id: Count  #: who asked
    grant: bool  #: hand it over now; else: not yet
    reason: Reason = ""  #: why not, for a person


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
    """One request, with the number by which its reply is recognised."""

    id: Count  #: chosen by the asker; comes back in the answer
    body: AnyRequest


# Answers -------------------------------------------------------------------------------------------------------


class Welcome(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """Answer to Hello."""

    app_id: Count  #: the application's number in this run of the proxy, from 1
    proxy: Name
    run_id: Count  #: random; another number means that the proxy was restarted
    pid: Count
    uri: str  #: of the vehicle
    now_ns: TimeNs  #: the proxy's clock
    capabilities: Capabilities
    clock: ClockName = ""  #: which monotonic clock it reads, on its host; empty: not known


class AuthorityGranted(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """The application holds the authority now."""

    lease: Count
    until_ns: TimeNs = 0  #: when the time is over for which it was wanted, on the proxy's clock; 0: it is not limited


class AuthorityQueued(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """Waiting in line: the grant comes as an event and shows in feedback (``owner_id``, ``lease``)."""

    position: Count  #: 1 is next
    holder: str
    holder_priority: Priority
    wait_s: float | None = None  #: expected, by how long the others stated that they want it; nil: not known
    asked: bool = False  #: the holder is being asked to hand it over


class ParameterValue(msgspec.Struct, frozen=True, array_like=True, tag=4):
    """A parameter, as it was read or is after it was written."""

    parameter: Parameter


class ParameterPage(msgspec.Struct, frozen=True, array_like=True, tag=5):
    """A page of the parameters; ``total`` counts all of them, ``first`` is the index of the first one here."""

    total: Count
    first: Count
    parameters: tuple[Parameter, ...]


class Pong(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """Answer to Ping, with its ``sent_ns``; ``now_ns`` is the proxy's clock."""

    sent_ns: TimeNs
    now_ns: TimeNs


class Done(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """It was done; there is nothing else to report."""


class Refused(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """The request was refused; ``message`` says why, for people."""

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
