"""The chaos run's judge finds each broken promise in journals, and reports none that was kept."""

from __future__ import annotations

import pytest

from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, dialect
from tests.promises.chaos.journal import Entry
from tests.promises.chaos.judge import Fault, Verdict, faults_of, judge
from tests.promises.chaos.radio import frames_of, is_stop

START_NS = 10**12


def entry(at_s: float, what: str, number: int = 0) -> Entry:
    return Entry(START_NS + round(at_s * 1e9), what, number)


def fault(kind: str, begin_s: float, end_s: float) -> Fault:
    return Fault(kind, START_NS + round(begin_s * 1e9), START_NS + round(end_s * 1e9))


class Flight:
    """Journals of a flight at 10 Hz from 0 to ``until_s``, with a gap in which the pilot is away."""

    def __init__(self, until_s: float = 20.0, away: tuple[float, float] = (0.0, 0.0)) -> None:
        self.pilot: list[Entry] = []
        self.vehicle = [entry(-2.0, "open"), entry(-1.9, "state:flying")]
        for number in range(1, round(until_s * 10)):
            at_s = number / 10
            if away[0] < at_s < away[1]:
                continue
            self.pilot += [entry(at_s, "call", number), entry(at_s + 0.001, "called", number)]
            self.vehicle.append(entry(at_s + 0.0005, "velocity", number))

    def judge(self, *faults: Fault) -> Verdict:
        by_time = sorted(self.vehicle, key=lambda line: line.at_ns)
        return judge(self.pilot, by_time, faults)


def test_a_flight_without_faults_breaks_nothing() -> None:
    verdict = Flight().judge()
    assert (verdict.calls, verdict.applied) == (199, 199)
    assert [verdict.stale, verdict.needless, verdict.missed, verdict.unrecovered] == [[]] * 4
    assert verdict.justified == 0
    assert verdict.delay_s == pytest.approx([0.0005] * 199)


@pytest.mark.parametrize(
    ("what", "number", "reason"),
    [
        (5.0, 4000, "never asked for"),
        (5.0, 30, "2.0"),  # the call of 3.0 s
    ],
)
def test_an_old_or_unrequested_command_is_stale(what: float, number: int, reason: str) -> None:
    flight = Flight()
    flight.vehicle.append(entry(what + 0.05, "velocity", number))
    (found,) = flight.judge().stale
    assert reason in found


def test_a_repeat_within_the_library_s_second_is_not_stale() -> None:
    flight = Flight()
    flight.vehicle.append(entry(5.9, "velocity", 50))
    assert not flight.judge().stale


def test_a_set_point_from_before_a_failsafe_is_stale_however_young() -> None:
    flight = Flight(away=(5.0, 6.0))
    flight.vehicle += [entry(5.5, "failsafe:hover"), entry(5.8, "velocity", 50)]
    (found,) = flight.judge(fault("pilot_stop", 5.05, 5.95)).stale
    assert "after a failsafe" in found


def test_a_set_point_that_waited_for_a_stalled_vehicle_is_not_stale() -> None:
    flight = Flight(away=(5.0, 7.5))
    flight.vehicle += [entry(5.6, "failsafe:hover"), entry(7.0, "velocity", 50)]
    stopped = fault("pilot_stop", 5.05, 7.5)
    assert len(flight.judge(stopped).stale) == 2, "one too old, one from before the failsafe"
    flight.vehicle.append(entry(6.99, "stalled", 1900))
    assert not flight.judge(stopped).stale


def test_a_failsafe_while_the_pilot_calls_is_needless() -> None:
    flight = Flight()
    flight.vehicle.append(entry(5.05, "failsafe:hover"))
    assert len(flight.judge().needless) == 1
    assert len(flight.judge(fault("request_flood", 4.0, 6.0)).needless) == 1, "a flood does not justify a failsafe"
    verdict = flight.judge(fault("proxy_stop", 4.0, 5.0))
    assert not verdict.needless, "an absent proxy justifies one"
    assert verdict.justified == 1


def test_a_failsafe_after_the_pilot_was_silent_is_due() -> None:
    flight = Flight(away=(5.0, 8.0))
    flight.vehicle.append(entry(5.55, "failsafe:hover"))
    verdict = flight.judge()
    assert (verdict.needless, verdict.justified) == ([], 1)


def test_a_call_that_ends_a_silence_and_is_still_under_way_makes_no_failsafe_needless() -> None:
    flight = Flight(away=(5.0, 5.6))
    flight.vehicle.append(entry(5.604, "failsafe:hover"))
    verdict = flight.judge()
    assert (verdict.needless, verdict.justified) == ([], 1)


@pytest.mark.parametrize(
    ("hover_s", "land_s", "missed"), [(5.52, 10.0, 0), (None, 10.0, 1), (5.52, None, 1), (7.0, 13.0, 2)]
)
def test_a_pilot_who_is_away_is_followed_by_hover_and_landing(
    hover_s: float | None, land_s: float | None, missed: int
) -> None:
    flight = Flight(until_s=20.0, away=(5.0, 13.0))
    if hover_s is not None:
        flight.vehicle.append(entry(hover_s, "failsafe:hover"))
    if land_s is not None:
        flight.vehicle.append(entry(land_s, "failsafe:land"))
    verdict = flight.judge(fault("pilot_stop", 5.0, 12.95))
    assert len(verdict.missed) == missed
    if missed == 0:
        assert verdict.hover_late_s == pytest.approx([0.02])


def test_no_failsafe_is_expected_of_a_proxy_that_is_away_nor_on_the_ground() -> None:
    flight = Flight(away=(5.0, 13.0))
    assert not flight.judge(fault("pilot_stop", 5.0, 12.95), fault("proxy_stop", 5.1, 12.0)).missed
    grounded = Flight(away=(5.0, 13.0))
    grounded.vehicle.append(entry(4.95, "state:landed"))
    assert not grounded.judge(fault("pilot_stop", 5.0, 12.95)).missed


def test_recovery_is_counted_to_the_first_new_set_point() -> None:
    verdict = Flight(away=(5.0, 8.0)).judge(fault("pilot_kill", 5.0, 7.5))
    assert verdict.recovery_s == {"pilot_kill": [pytest.approx(0.5005)]}
    assert Flight(until_s=6.0).judge(fault("proxy_kill", 5.0, 7.0)).unrecovered


def test_faults_are_read_from_their_beginnings_and_ends() -> None:
    lines = [entry(1, "begin:hog"), entry(2, "end:hog"), entry(3, "begin:hog"), entry(4, "end:other")]
    assert faults_of(lines) == [fault("hog", 1, 2)]


# Flights that no pilot requested ------------------------------------


class TakeOff:
    """Journals of one take-off at 1 s, up at 2 s; a test adds its own entries after it."""

    def __init__(self, *pilot: Entry) -> None:
        self.pilot = [entry(1.0, "ask_takeoff"), *pilot]
        self.vehicle = [entry(-2.0, "open"), entry(-1.9, "state:landed"), entry(1.1, "armed")]
        self.vehicle += [entry(1.2, "state:taking_off"), entry(2.0, "state:flying")]

    def unasked(self, *more: Entry, during: Fault | None = None) -> list[str]:
        by_time = sorted([*self.vehicle, *more], key=lambda line: line.at_ns)
        return judge(self.pilot, by_time, [during] if during else []).unasked


LANDED = (entry(3.0, "other:land"), entry(3.1, "state:landing"), entry(5.0, "state:landed"))
AGAIN = entry(5.1, "state:taking_off")


def test_a_requested_takeoff_is_attributed_to_it() -> None:
    assert TakeOff().unasked() == []
    assert TakeOff(entry(9.0, "ask_takeoff")).unasked(*LANDED, entry(9.1, "armed"), entry(9.2, "state:flying")) == []


def test_an_unrequested_takeoff_is_reported_with_its_history() -> None:
    flight = TakeOff()
    flight.pilot = []
    assert all("no take-off was ever asked for" in text for text in flight.unasked())
    (found,) = TakeOff().unasked(*LANDED, AGAIN, during=fault("landed_in_its_takeoff", 0.5, 6.0))
    assert "left ground" in found
    assert "asked for 4.100 s before" in found
    assert "ended by other:land 2.100 s before" in found
    assert "landed_in_its_takeoff began 4.600 s before" in found


@pytest.mark.parametrize(
    "ended",
    [
        (entry(3.0, "disarmed"), entry(3.0, "state:emergency")),
        (entry(3.0, "other:tip"), entry(3.1, "state:landed")),
        (entry(3.0, "failsafe:land"), entry(5.0, "state:landed")),
        (entry(3.0, "state:landed"),),
    ],
)
def test_events_that_end_a_takeoff(ended: tuple[Entry, ...]) -> None:
    assert len(TakeOff().unasked(*ended, entry(5.1, "armed"), entry(5.2, "state:flying"))) == 2


def test_a_takeoff_request_does_not_last_forever() -> None:
    flight = TakeOff()
    flight.vehicle = [entry(-1.9, "state:landed")]
    assert flight.unasked(entry(20.0, "armed"), entry(20.1, "state:flying")) == []
    assert len(flight.unasked(entry(40.0, "armed"), entry(40.1, "state:flying"))) == 2


def test_only_a_takeoff_requests_to_take_over_a_vehicle() -> None:
    assert len(TakeOff().unasked(entry(3.0, "other:land"), entry(3.5, "guided"))) == 1
    assert TakeOff().unasked(entry(3.5, "guided")) == []


def test_a_movement_without_a_stick_is_found() -> None:
    (found,) = TakeOff().unasked(entry(3.0, "moved", 700))
    assert "moved at 0.70 m/s" in found


def test_sticks_fly_nothing_after_an_emergency_stop_though_its_packet_is_lost() -> None:
    flight = TakeOff(entry(2.5, "call", 7), entry(3.0, "ask_stop"))
    assert flight.unasked(entry(3.1, "velocity", 7)) == []
    assert len(flight.unasked(entry(3.5, "velocity", 7))) == 1


@pytest.mark.parametrize(("at_s", "missed"), [(3.4, 0), (7.0, 1), (None, 1)])
def test_an_emergency_stop_is_executed_within_its_time(at_s: float | None, missed: int) -> None:
    flight = TakeOff(entry(3.0, "ask_stop"))
    flight.vehicle += [] if at_s is None else [entry(at_s, "disarmed")]
    verdict = judge(flight.pilot, flight.vehicle, [])
    assert len(verdict.missed) == missed


def test_a_landing_that_neither_pilot_nor_failsafe_requested_is_needless() -> None:
    taken_off = TakeOff()
    taken_off.vehicle += [entry(3.0, "land")]
    assert len(judge(taken_off.pilot, taken_off.vehicle, []).needless) == 1
    flight = Flight(away=(5.0, 13.0))
    flight.vehicle += [entry(5.52, "failsafe:hover"), entry(10.0, "failsafe:land"), entry(10.0, "land")]
    assert not flight.judge(fault("pilot_stop", 5.0, 12.95)).needless


# Between a vehicle and its proxy ---------------------------------------------------


@pytest.mark.parametrize("armed", [False, True])
def test_an_emergency_stop_of_a_disarmed_vehicle_is_not_missed(armed: bool) -> None:
    """Failsafes landed it before, so nothing remained to disarm; except if a propeller turns again."""
    flight = TakeOff(entry(5.0, "ask_stop"))
    flight.vehicle += [entry(3.0, "state:landed"), entry(3.1, "disarmed"), entry(6.0, "disarmed" if armed else "open")]
    flight.vehicle[-1:-1] = [entry(4.0, "armed")] * armed
    assert judge(flight.pilot, flight.vehicle, []).stop_s == [1.0 if armed else 0.0]


def test_a_stop_is_known_among_frames_that_a_stream_cuts_anywhere() -> None:
    codec = MavlinkCodec(255, 190)

    def command(number: int, *arguments: float) -> bytes:
        padded = (*arguments, *[0.0] * (7 - len(arguments)))
        return codec.encode(dialect.MAVLink_command_long_message(1, 1, number, 0, *padded))

    stop, disarm = command(400, 0.0, 21196.0), command(400, 0.0)
    frames = [disarm, stop, command(176, 1.0, 4.0)]
    assert [is_stop(frame) for frame in frames] == [False, True, False]
    stream, buffer = bytes(9) + b"".join(frames), bytearray()
    found: list[bytes] = []
    for at in range(0, len(stream), 7):
        buffer += stream[at : at + 7]
        found += frames_of(buffer)
    assert found == frames
