"""Types of the samples' fields: ranges of numbers, and closed vocabularies.

A sample may come from anybody who may connect, and many programs use what is in it: as a size, an index, a time or
the bound of a loop. So its numbers are bounded here once, where it comes in, and not at each place of use. Each member
of a vocabulary is its own string, so ``state == "hovering"`` reads well.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Final

import msgspec

#: What counts up: sequence numbers, leases, numbers of applications. Python's ints have no end, others' have 64 bits.
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]

#: 73 years: beyond what a monotonic clock shows, and little enough that a time, an offset between two clocks and the
#: Unix time of their start can be added up in 64 bits.
LATEST_NS: Final = 2**61
#: A time on a monotonic clock [ns].
TimeNs = Annotated[int, msgspec.Meta(ge=-LATEST_NS, le=LATEST_NS)]

#: A number that is neither NaN nor infinite.
Finite = Annotated[float, msgspec.Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
Pixels = Annotated[int, msgspec.Meta(ge=1, le=16384)]

#: Three finite numbers, along x, y and z.
Vector = tuple[Finite, Finite, Finite]
#: A value of a vehicle's native telemetry, of a parameter or of an event's particulars.
Value = bool | int | float | str | tuple[float, ...]


def shape_fits(shape: Sequence[int], count: int, most: int) -> bool:
    """Return whether an array of this shape has the given number of elements and no axis of excessive length.

    An axis of length 0 makes any other lengths fit, and a loop over those would never end. So the lengths are also
    multiplied with each 0 taken as 1, and bounded.

    Args:
        shape: The length of each axis.
        count: The number of elements.
        most: The largest product of the lengths, each 0 taken as 1.
    """
    return math.prod(shape) == count and math.prod(max(1, length) for length in shape) <= most


class FlightState(StrEnum):
    """What the vehicle is doing, as the vehicle (or the software autopilot for it) reports."""

    UNKNOWN = "unknown"  #: nothing received yet
    LANDED = "landed"
    TAKING_OFF = "taking_off"
    HOVERING = "hovering"  #: airborne, holding its place by itself
    FLYING = "flying"  #: airborne, following a set-point
    LANDING = "landing"
    EMERGENCY = "emergency"  #: motors cut; left only by an explicit reset

    @property
    def airborne(self) -> bool:
        """Whether the vehicle is off the ground under its own power."""
        return self in _AIRBORNE


_AIRBORNE = frozenset({FlightState.TAKING_OFF, FlightState.HOVERING, FlightState.FLYING, FlightState.LANDING})


class LinkState(StrEnum):
    """State of one hop (application–proxy, or proxy–vehicle)."""

    CONNECTING = "connecting"  #: first attempt under way, nothing received yet
    UP = "up"
    DEGRADED = "degraded"  #: up, but samples are missing, late or malformed
    LOST = "lost"  #: nothing received past the threshold; recovery goes on by itself
    CLOSED = "closed"  #: ended on purpose; nothing more will come


class Failsafe(StrEnum):
    """The step of the failsafe ladder that is in force."""

    NONE = "none"
    HOVER = "hover"  #: the pilot is silent or gone: holding the place
    LAND = "land"  #: still no pilot, or the battery is low: landing


class ReturnPhase(StrEnum):
    """How far a vehicle is on its way back to where it took off."""

    NONE = "none"  #: it is not on its way back
    CLIMBING = "climbing"  #: to the height that it flies back at
    FLYING = "flying"  #: towards the start
    ARRIVED = "arrived"  #: stays above the start
    LANDING = "landing"  #: lands there


class Encoding(StrEnum):
    """How the bytes of a frame are to be read."""

    BGR8 = "bgr8"  #: height × width × 3 bytes, blue first (OpenCV's order), rows without padding
    RGB8 = "rgb8"  #: the same, red first
    MONO8 = "mono8"  #: height × width bytes
    JPEG = "jpeg"  #: one JPEG file


class Role(StrEnum):
    """What an application asks to be when it connects."""

    PILOT = "pilot"  #: may request the authority, and may stop the motors in an emergency
    OBSERVER = "observer"  #: read-only for as long as it is connected


class Takeover(StrEnum):
    """How somebody who asks for the authority takes it from a holder of lower priority."""

    NOW = "now"  #: at once
    ASK = "ask"  #: the holder is asked first, and after a time the higher priority wins


class Severity(StrEnum):
    """How serious an event is."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class EventKind(StrEnum):
    """What happened. ``Event.data`` holds the particulars named here."""

    APPLICATION_LINK = "application_link"  #: hop application–proxy changed; data: state, reason
    VEHICLE_LINK = "vehicle_link"  #: hop proxy–vehicle changed, or why it is so; data: state, reason, remedy
    AUTHORITY_GRANTED = "authority_granted"  #: data: app_id, priority, lease, identity; until_ns if for a time
    AUTHORITY_QUEUED = "authority_queued"  #: waits, or has moved up; data: app_id, priority, position; wait_s if known
    AUTHORITY_LOST = "authority_lost"  #: data: app_id, lease, reason (released, silent, gone, expired), by (app name)
    AUTHORITY_PREEMPTED = "authority_preempted"  #: data: app_id, lease, by, by_id, by_priority, granted
    AUTHORITY_ASKED = "authority_asked"  #: the holder is asked for it; data: app_id, lease, by, by_id, by_priority …
    AUTHORITY_DECLINED = "authority_declined"  #: and declined; data: app_id (who asked), by (the holder), reason
    AUTHORITY_WITHDRAWN = "authority_withdrawn"  #: and asks no more; data: app_id (the holder), lease, by, by_id
    AUTHORITY_EXPIRED = "authority_expired"  #: the holder's time is over, and nobody waits; data: app_id, lease
    FAILSAFE = "failsafe"  #: a step of the ladder was taken or left; data: step, reason
    COMMAND_REFUSED = "command_refused"  #: data: reason (a Refusal), seq, count
    COMMAND_CLAMPED = "command_clamped"  #: a set-point was beyond a limit; data: limit, asked, applied
    PACKET_MALFORMED = "packet_malformed"  #: data: reason, count
    STATE_CHANGED = "state_changed"  #: flight state; data: before, after
    BATTERY_LOW = "battery_low"  #: data: battery
    EMERGENCY = "emergency"  #: motors cut; data: reason
    PARAMETER_CHANGED = "parameter_changed"  #: data: name, value, app_id (who wrote it)
    DRIVER_ERROR = "driver_error"  #: the driver failed in some call; data: where
    COLLISION = "collision"  #: simulated vehicles: touched something; data: speed_m_s
    VEHICLE_MESSAGE = "vehicle_message"  #: text from the vehicle itself
    SAMPLES_LOST = "samples_lost"  #: events that a slow application did not get; data: count
    CALLBACK_ERROR = "callback_error"  #: an application's own listener or processor raised; data: where
    RECORDING = "recording"  #: a recorder started, ended, dropped samples or can't write; data: state, path
    PROCESSOR = "processor"  #: a worker joined, left, or gave up its share for a time; data: processor, state, app_id
    KEYS = "keys"  #: of the network: one ends within a week, or the roster has changed
    PROXY_CLOSING = "proxy_closing"  #: the proxy ends on purpose


class Refusal(StrEnum):
    """Why a command or a request was refused."""

    MALFORMED = "malformed"
    OUT_OF_SEQUENCE = "out_of_sequence"  #: not newer than the last one received
    STALE = "stale"  #: sent too long ago (or in the future)
    NO_AUTHORITY = "no_authority"  #: the sender holds no lease
    FOREIGN_LEASE = "foreign_lease"  #: the lease named is not the one in force
    NON_FINITE = "non_finite"  #: NaN or infinite
    NOT_FRESH = "not_fresh"  #: repeats an intent from before a failsafe or a loss of the vehicle's link
    VEHICLE_LINK_LOST = "vehicle_link_lost"
    UNSUPPORTED = "unsupported"  #: neither the vehicle nor the software autopilot can do it
    WRONG_STATE = "wrong_state"  #: not possible in the present flight state
    OBSERVER = "observer"  #: the application connected as an observer
    UNKNOWN_PARAMETER = "unknown_parameter"
    WRONG_TYPE = "wrong_type"
    OUT_OF_RANGE = "out_of_range"
    READ_ONLY = "read_only"
    DRIVER_FAILED = "driver_failed"
    BUSY = "busy"  #: an application of at least the same priority holds the authority
    NAME_TAKEN = "name_taken"  #: other code, or another way to share, goes by that name
    PROTOCOL = "protocol"  #: a request out of place, or of another protocol version
