"""Define the types of the samples' fields: bounded numbers and fixed vocabularies.

Samples may come from any program that can connect, and programs use their numbers as sizes, indices, times and loop
bounds. Therefore numbers are limited here, once, on arrival, rather than wherever they are used. Each enumeration
member equals its string, so ``state == "hovering"`` works.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Final

import msgspec

#: A counter, such as a sequence, lease or application number. Python's integers are unbounded; others use 64 bits.
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]

#: The latest allowed time, 73 years. No monotonic clock reaches it. The sum of a time, an offset between two clocks and
#: the Unix time at which they started still fits into 64 bits.
LATEST_NS: Final = 2**61
#: A time on a monotonic clock [ns].
TimeNs = Annotated[int, msgspec.Meta(ge=-LATEST_NS, le=LATEST_NS)]

#: A number that is neither NaN nor infinite.
Finite = Annotated[float, msgspec.Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
Pixels = Annotated[int, msgspec.Meta(ge=1, le=16384)]

#: Three finite numbers: the components along x, y and z.
Vector = tuple[Finite, Finite, Finite]
#: A value in native telemetry, a parameter or the data of an event.
Value = bool | int | float | str | tuple[float, ...]


def shape_fits(shape: Sequence[int], count: int, most: int) -> bool:
    """Return whether an array of this shape has ``count`` elements and no excessively long axis.

    If one length is 0, the product of all lengths is 0 however large the others are, and a loop over the others would
    never end. Therefore the product, with each 0 counted as 1, must be at most ``most``.
    """
    return math.prod(shape) == count and math.prod(max(1, length) for length in shape) <= most


class FlightState(StrEnum):
    """What the vehicle is doing, as reported by the vehicle or its software autopilot."""

    UNKNOWN = "unknown"  #: nothing has been received yet
    LANDED = "landed"
    TAKING_OFF = "taking_off"
    HOVERING = "hovering"  #: airborne, holding its position
    FLYING = "flying"  #: airborne, following a set-point
    LANDING = "landing"
    EMERGENCY = "emergency"  #: motors cut; only an explicit reset ends this state

    @property
    def airborne(self) -> bool:
        """Whether the vehicle is off the ground under its own power."""
        return self in _AIRBORNE


_AIRBORNE = frozenset({FlightState.TAKING_OFF, FlightState.HOVERING, FlightState.FLYING, FlightState.LANDING})


class LinkState(StrEnum):
    """State of one link: from the application to the proxy, or from the proxy to the vehicle."""

    CONNECTING = "connecting"  #: first attempt in progress, nothing received yet
    UP = "up"
    DEGRADED = "degraded"  #: up, but samples are missing, late or malformed
    LOST = "lost"  #: nothing received for too long; reconnects automatically
    CLOSED = "closed"  #: closed deliberately; nothing more will arrive


class Failsafe(StrEnum):
    """The active step of the failsafe ladder."""

    NONE = "none"
    HOVER = "hover"  #: holding position because the pilot is gone or sends nothing
    LAND = "land"  #: landing because there is still no pilot or because the battery is low


class ReturnPhase(StrEnum):
    """A vehicle's progress on its return flight."""

    NONE = "none"  #: not returning
    CLIMBING = "climbing"  #: climbing to the height of the return flight
    FLYING = "flying"  #: flying towards the start
    ARRIVED = "arrived"  #: hovering above the start
    LANDING = "landing"  #: landing at the start


class Encoding(StrEnum):
    """Format of a frame's bytes."""

    BGR8 = "bgr8"  #: height × width × 3 bytes, blue first (OpenCV's order), rows without padding
    RGB8 = "rgb8"  #: like ``BGR8``, but with red first
    MONO8 = "mono8"  #: height × width bytes
    JPEG = "jpeg"  #: one JPEG file


CHANNELS: Final = {Encoding.BGR8: 3, Encoding.RGB8: 3, Encoding.MONO8: 1}  #: bytes per pixel of the raw encodings


class Role(StrEnum):
    """The role requested by an application when it connects."""

    PILOT = "pilot"  #: may request the authority, and may stop the motors in an emergency
    OBSERVER = "observer"  #: may only read


class Takeover(StrEnum):
    """How an authority request displaces a holder of lower priority."""

    NOW = "now"  #: takes the authority immediately
    ASK = "ask"  #: asks the holder first; after a delay, the higher priority wins


class Severity(StrEnum):
    """How serious an event is."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class EventKind(StrEnum):
    """Kinds of events. Comments list the keys of ``Event.data``."""

    APPLICATION_LINK = "application_link"  #: the link from application to proxy has changed; data: state, reason
    VEHICLE_LINK = "vehicle_link"  #: the link from proxy to vehicle or its reason changed; data: state, reason, remedy
    AUTHORITY_GRANTED = "authority_granted"  #: data: app_id, priority, lease, identity; until_ns if limited
    AUTHORITY_QUEUED = "authority_queued"  #: queued, or moved up; data: app_id, priority, position; wait_s if known
    AUTHORITY_LOST = "authority_lost"  #: data: app_id, lease, reason (released, silent, gone, expired), by (app name)
    AUTHORITY_PREEMPTED = "authority_preempted"  #: data: app_id, lease, by, by_id, by_priority, granted
    AUTHORITY_ASKED = "authority_asked"  #: a request to the holder; data: app_id, lease, by, by_id, by_priority …
    AUTHORITY_DECLINED = "authority_declined"  #: data: app_id (the requester), by (the holder), reason
    AUTHORITY_WITHDRAWN = "authority_withdrawn"  #: the requester gave up; data: app_id (the holder), lease, by, by_id
    AUTHORITY_EXPIRED = "authority_expired"  #: the holder's time has expired and nobody is queued; data: app_id, lease
    FAILSAFE = "failsafe"  #: a step of the failsafe ladder began or ended; data: step, reason
    COMMAND_REFUSED = "command_refused"  #: data: reason (a Refusal), seq, count
    COMMAND_CLAMPED = "command_clamped"  #: a set-point exceeded a limit; data: limit, asked, applied
    PACKET_MALFORMED = "packet_malformed"  #: data: reason, count
    STATE_CHANGED = "state_changed"  #: the flight state has changed; data: before, after
    BATTERY_LOW = "battery_low"  #: data: battery
    EMERGENCY = "emergency"  #: motors cut; data: reason
    PARAMETER_CHANGED = "parameter_changed"  #: data: name, value, app_id (who wrote it)
    DRIVER_ERROR = "driver_error"  #: a call to the driver failed; data: where
    COLLISION = "collision"  #: a simulated vehicle touched something; data: speed_m_s
    VEHICLE_MESSAGE = "vehicle_message"  #: text from the vehicle itself
    SAMPLES_LOST = "samples_lost"  #: a slow application missed events; data: count
    CALLBACK_ERROR = "callback_error"  #: an application's own callback or processor raised an exception; data: where
    RECORDING = "recording"  #: recording started, ended, lost samples or can't write; data: state, path
    PROCESSOR = "processor"  #: a worker joined, left, or paused; data: processor, state, app_id
    KEYS = "keys"  #: a network key expires within a week, or the roster has changed
    PROXY_CLOSING = "proxy_closing"  #: the proxy is shutting down deliberately


class Refusal(StrEnum):
    """Reasons for refusing a command or a request."""

    MALFORMED = "malformed"
    OUT_OF_SEQUENCE = "out_of_sequence"  #: not newer than the last packet received
    STALE = "stale"  #: sent too long ago (or in the future)
    NO_AUTHORITY = "no_authority"  #: the sender holds no lease
    FOREIGN_LEASE = "foreign_lease"  #: the given lease is not the current one
    NON_FINITE = "non_finite"  #: NaN or infinite
    NOT_FRESH = "not_fresh"  #: repeats an intent from before a failsafe or a loss of the vehicle link
    VEHICLE_LINK_LOST = "vehicle_link_lost"
    UNSUPPORTED = "unsupported"  #: neither the vehicle nor the software autopilot supports it
    WRONG_STATE = "wrong_state"  #: not possible in the current flight state
    OBSERVER = "observer"  #: the application connected as an observer
    UNKNOWN_PARAMETER = "unknown_parameter"
    WRONG_TYPE = "wrong_type"
    OUT_OF_RANGE = "out_of_range"
    READ_ONLY = "read_only"
    DRIVER_FAILED = "driver_failed"
    BUSY = "busy"  #: an application with at least the same priority holds the authority
    NAME_TAKEN = "name_taken"  #: other code uses this name, or uses a different setting of ``shared``
    PROTOCOL = "protocol"  #: a request in the wrong order, or in a different protocol version
