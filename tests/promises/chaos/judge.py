"""Derives from a lane's journals which promises were kept. Pure.

Times are of one host's monotonic clock. A *disruption* is a fault that takes the pilot, the proxy or the vehicle's
link away, so that a failsafe is expected; any other fault must leave the flight as it is.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from tests.promises.chaos.journal import Entry
from tests.promises.chaos.vehicle import NUMBERS

HOVER_AFTER_S: Final = 0.5  #: the proxy's defaults: failsafe.hover_after_s …
LAND_AFTER_S: Final = 5.0  #: … failsafe.land_after_s …
MAX_AGE_S: Final = 0.25  #: … and command.max_age_s
STALL_S: Final = 1.0  #: how long the library repeats a set-point without a call
#: Between the moment that counts and the line in the journal: the scheduler and, on a loaded machine, its queue.
SLACK_S: Final = 0.05
#: A call reaches the proxy within this. An earlier failsafe can't be a consequence of the silence before the call.
ARRIVES_S: Final = 0.1
#: A failsafe that is later than this was missed.
LATE_S: Final = 1.0
#: Every take-off request is over by then.
TAKEOFF_S: Final = 30.0
#: An emergency stop is executed within this, even if its first packets are lost.
STOP_S: Final = 3.0
#: A failsafe's landing reaches the vehicle within this, even if the link is lost for a while.
LANDS_S: Final = 30.0
#: A set-point already being sent when a stop was pressed may still be executed.
UNDER_WAY_S: Final = 0.3
DISRUPTIONS: Final = frozenset({"pilot_stop", "pilot_kill", "proxy_stop", "proxy_kill", "full_serial_port"})
_PILOT: Final = frozenset({"pilot_stop", "pilot_kill"})
_AIRBORNE: Final = frozenset({"state:taking_off", "state:hovering", "state:flying"})
_DOWN: Final = frozenset({"state:landed", "state:emergency"})
#: Each of these ends a pilot's take-off: nothing may turn a propeller after it.
_ENDS: Final = frozenset({"touched_down", "disarmed", "other:land", "other:tip", "failsafe:land", "land", "ask_stop"})


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a lane, with its beginning and end [ns]."""

    kind: str
    begin_ns: int
    end_ns: int


@dataclass(slots=True)
class Verdict:
    """The findings for one lane. Times in s."""

    calls: int = 0
    applied: int = 0
    stale: list[str] = field(default_factory=list)
    needless: list[str] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    unrecovered: list[str] = field(default_factory=list)
    unasked: list[str] = field(default_factory=list)  #: flights that no pilot requested
    justified: int = 0  #: failsafes justified by a process's silence or death
    hover_late_s: list[float] = field(default_factory=list)  #: after ``failsafe.hover_after_s``; negative: before
    recovery_s: dict[str, list[float]] = field(default_factory=dict)
    delay_s: list[float] = field(default_factory=list)  #: from the call to the vehicle
    stop_s: list[float] = field(default_factory=list)  #: from an emergency stop to standing motors


def faults_of(entries: Iterable[Entry]) -> list[Fault]:
    """The faults that began and ended, from ``begin:KIND`` and ``end:KIND``; they do not overlap in a lane."""
    faults, begun = [], {}
    for entry in entries:
        verb, _, kind = entry.what.partition(":")
        if verb == "begin":
            begun[kind] = entry.at_ns
        elif verb == "end" and kind in begun:
            faults.append(Fault(kind, begun.pop(kind), entry.at_ns))
    return faults


def judge(
    pilot: Sequence[Entry], vehicle: Sequence[Entry], faults: Sequence[Fault], *, transit_s: float = 0.0
) -> Verdict:
    """Which promises one lane kept, from its sorted journals.

    ``transit_s``: how long a set-point may be under way from the proxy to its line in the vehicle's journal.
    """
    verdict = Verdict(calls=sum(entry.what == "call" for entry in pilot))
    calls = _Calls(pilot)
    failsafes = [entry.at_ns for entry in vehicle if entry.what.startswith("failsafe:")]
    _judge_ages(verdict, calls, vehicle, [at_ns + _ns(transit_s) for at_ns in failsafes])
    disruptions = [fault for fault in faults if fault.kind in DISRUPTIONS]
    windows = _judge_recoveries(verdict, calls, vehicle, disruptions)
    windows += [(entry.at_ns, entry.at_ns + _ns(1.0)) for entry in vehicle if entry.what == "open"]
    _judge_needless(verdict, calls, vehicle, windows, faults)
    _judge_missed(verdict, vehicle, disruptions)
    _judge_flights(verdict, pilot, vehicle, faults)
    _judge_stops(verdict, pilot, vehicle)
    return verdict


class _Calls:
    """When the pilot's calls began and ended."""

    def __init__(self, pilot: Sequence[Entry]) -> None:
        self.begins = [entry.at_ns for entry in pilot if entry.what == "call"]
        self._by_number: dict[int, list[tuple[int, int]]] = {}
        ends = {entry.number: entry.at_ns for entry in pilot if entry.what == "called"}
        for entry in pilot:
            if entry.what == "call":
                times = entry.at_ns, ends.get(entry.number, entry.at_ns)
                self._by_number.setdefault(entry.number % NUMBERS, []).append(times)

    def of(self, number: int, at_ns: int) -> tuple[int, int] | None:
        """Beginning and end of the newest call with this number that began before this time."""
        known = [times for times in self._by_number.get(number, []) if times[0] <= at_ns]
        return known[-1] if known else None


def _judge_ages(verdict: Verdict, calls: _Calls, vehicle: Sequence[Entry], failsafes: Sequence[int]) -> None:
    """Nothing old is executed: no set-point without a recent call, none from before a failsafe."""
    stalls = [(entry.at_ns - entry.number * 1_000_000, entry.at_ns) for entry in vehicle if entry.what == "stalled"]
    stall_ends = [end for _, end in stalls]
    for entry in vehicle:
        if entry.what != "velocity":
            continue
        verdict.applied += 1
        times = calls.of(entry.number, entry.at_ns)
        if times is None:
            verdict.stale.append(f"number {entry.number} was executed and never asked for")
            continue
        begin_ns, end_ns = times
        verdict.delay_s.append((entry.at_ns - begin_ns) / 1e9)
        # While the vehicle's own process is suspended, it does not read what has arrived.
        meanwhile = stalls[bisect_left(stall_ends, end_ns) : bisect_right(stall_ends, entry.at_ns)]
        at_ns = entry.at_ns - sum(end - max(begin, end_ns) for begin, end in meanwhile)
        age_s = (at_ns - end_ns) / 1e9
        if age_s > STALL_S + MAX_AGE_S + SLACK_S:
            verdict.stale.append(f"number {entry.number} was executed {age_s:.3f} s after its call")
        # A command already being sent when the failsafe came may still be executed, if it is recent enough.
        after = bisect_right(failsafes, end_ns + _ns(MAX_AGE_S + SLACK_S))
        if after < len(failsafes) and failsafes[after] < at_ns:
            verdict.stale.append(f"number {entry.number} was executed after a failsafe that came after its call")


def _judge_recoveries(
    verdict: Verdict, calls: _Calls, vehicle: Sequence[Entry], disruptions: Sequence[Fault]
) -> list[tuple[int, int]]:
    """How soon each disruption was over, and the spans of time in which a failsafe is expected."""
    windows = []
    velocities = [entry for entry in vehicle if entry.what == "velocity"]
    times = [entry.at_ns for entry in velocities]
    for fault in disruptions:
        flown_ns = None
        for entry in velocities[bisect_left(times, fault.end_ns) :]:
            asked = calls.of(entry.number, entry.at_ns)
            if asked is not None and asked[1] >= fault.end_ns:
                flown_ns = entry.at_ns
                break
        if flown_ns is None:
            verdict.unrecovered.append(f"{fault.kind} at {fault.begin_ns / 1e9:.1f} s")
            windows.append((fault.begin_ns, fault.end_ns + _ns(60.0)))
        else:
            verdict.recovery_s.setdefault(fault.kind, []).append((flown_ns - fault.end_ns) / 1e9)
            windows.append((fault.begin_ns, flown_ns + _ns(HOVER_AFTER_S)))
    return windows


def _judge_needless(
    verdict: Verdict,
    calls: _Calls,
    vehicle: Sequence[Entry],
    windows: Sequence[tuple[int, int]],
    faults: Sequence[Fault],
) -> None:
    landings = [entry.at_ns for entry in vehicle if entry.what == "failsafe:land"]
    for entry in vehicle:
        if entry.what == "land" and not any(-_ns(LATE_S) <= entry.at_ns - at_ns <= _ns(LANDS_S) for at_ns in landings):
            verdict.needless.append(f"landed at {entry.at_ns / 1e9:.3f} s, which no pilot and no failsafe wanted")
        if not entry.what.startswith("failsafe:"):
            continue
        last = bisect_right(calls.begins, entry.at_ns - _ns(ARRIVES_S))
        silent_s = (entry.at_ns - calls.begins[last - 1]) / 1e9 if last else float("inf")
        if silent_s >= HOVER_AFTER_S - SLACK_S or any(begin <= entry.at_ns <= end for begin, end in windows):
            verdict.justified += 1
        else:
            before = [fault for fault in faults if fault.begin_ns <= entry.at_ns]
            when = f"{(entry.at_ns - before[-1].begin_ns) / 1e9:.3f} s after {before[-1].kind} began" if before else ""
            verdict.needless.append(
                f"{entry.what} {silent_s:.3f} s after a call that had arrived, {when or 'before any fault'}"
            )


def _judge_missed(verdict: Verdict, vehicle: Sequence[Entry], disruptions: Sequence[Fault]) -> None:
    """When a pilot is stopped or killed, hover and then landing must follow, while the proxy runs."""
    states = [entry for entry in vehicle if entry.what.startswith("state:")]
    times = [entry.at_ns for entry in states]

    def airborne(at_ns: int) -> bool:
        place = bisect_right(times, at_ns)
        return place > 0 and states[place - 1].what in _AIRBORNE

    absences = [fault for fault in disruptions if fault.kind not in _PILOT]
    for fault in disruptions:
        if fault.kind not in _PILOT:
            continue
        for step, after_s in (("hover", HOVER_AFTER_S), ("land", LAND_AFTER_S)):
            limit_ns = fault.begin_ns + _ns(after_s + LATE_S)
            proxy_away = any(other.begin_ns < limit_ns and other.end_ns > fault.begin_ns for other in absences)
            if fault.end_ns < limit_ns or proxy_away or not airborne(fault.begin_ns + _ns(after_s) // 2):
                continue
            came = [
                entry.at_ns
                for entry in vehicle
                if entry.what == f"failsafe:{step}" and fault.begin_ns - _ns(SLACK_S) <= entry.at_ns <= limit_ns
            ]
            if not came:
                verdict.missed.append(f"{step} after {fault.kind} at {fault.begin_ns / 1e9:.3f} s")
            elif step == "hover":
                verdict.hover_late_s.append((came[0] - fault.begin_ns) / 1e9 - HOVER_AFTER_S)


def _judge_flights(verdict: Verdict, pilot: Sequence[Entry], vehicle: Sequence[Entry], faults: Sequence[Fault]) -> None:
    """Leaving the ground, arming and taking over from others need a pilot's take-off that is still in force."""
    history = sorted([*_with_touch_downs(vehicle), *pilot], key=lambda entry: entry.at_ns)
    asked: Entry | None = None
    ended: Entry | None = None
    others = False  # another station has decided the vehicle's fate
    stopped_ns: int | None = None
    for entry in history:
        if entry.what == "ask_takeoff":
            asked, ended, others, stopped_ns = entry, None, False, None
        elif entry.what in _ENDS:
            ended = ended or entry
            others = others or entry.what.startswith("other:")
            stopped_ns = entry.at_ns if entry.what == "ask_stop" else stopped_ns
        wrong = ""
        in_force = asked is not None and ended is None and entry.at_ns - asked.at_ns <= _ns(TAKEOFF_S)
        if entry.what in ("armed", "left_ground") and not in_force:
            wrong = entry.what.replace("_", " ")
        elif entry.what == "guided" and others:
            wrong = "taken from others"
        elif entry.what == "moved":
            wrong = f"moved at {entry.number / 1000:.2f} m/s"
        elif entry.what == "velocity" and stopped_ns is not None and entry.at_ns - stopped_ns > _ns(UNDER_WAY_S):
            wrong = "flown by sticks after an emergency stop"
        if wrong:
            verdict.unasked.append(f"{wrong} {_led_to(entry, asked, ended, faults)}")


def _with_touch_downs(vehicle: Sequence[Entry]) -> list[Entry]:
    """The vehicle's entries, with entries for each lift-off and touch-down."""
    found, down = [], True
    for entry in vehicle:
        if entry.what.startswith("state:") and (entry.what in _DOWN) is not down:
            down = not down
            found.append(Entry(entry.at_ns, "touched_down" if down else "left_ground"))
        found.append(entry)
    return found


def _led_to(entry: Entry, asked: Entry | None, ended: Entry | None, faults: Sequence[Fault]) -> str:
    """The history of an event, as a sentence."""

    def ago(at_ns: int) -> str:
        return f"{(entry.at_ns - at_ns) / 1e9:.3f} s before"

    parts = [f"at {entry.at_ns / 1e9:.3f} s"]
    parts.append("no take-off was ever asked for" if asked is None else f"a take-off asked for {ago(asked.at_ns)}")
    if ended is not None:
        parts.append(f"ended by {ended.what.replace('_', ' ')} {ago(ended.at_ns)}")
    before = [fault for fault in faults if fault.begin_ns <= entry.at_ns]
    if before:
        parts.append(f"{before[-1].kind} began {ago(before[-1].begin_ns)}")
    return ", ".join(parts)


def _judge_stops(verdict: Verdict, pilot: Sequence[Entry], vehicle: Sequence[Entry]) -> None:
    """An emergency stop is executed even if packets are lost. A vehicle disarmed at that moment stays so."""
    stood = [entry.at_ns for entry in vehicle if entry.what in ("disarmed", "state:emergency")]
    turned = [entry for entry in vehicle if entry.what in ("armed", "disarmed")]
    for entry in pilot:
        if entry.what == "ask_stop":
            place = bisect_left(stood, entry.at_ns)
            after_s = (stood[place] - entry.at_ns) / 1e9 if place < len(stood) else float("inf")
            before = [each.what for each in turned if each.at_ns <= entry.at_ns]
            after_s = 0.0 if before[-1:] == ["disarmed"] else after_s
            verdict.stop_s.append(after_s)
            if after_s > STOP_S:
                verdict.missed.append(f"emergency stop at {entry.at_ns / 1e9:.3f} s: it stood {after_s:.3f} s later")


def _ns(span_s: float) -> int:
    return round(span_s * 1e9)
