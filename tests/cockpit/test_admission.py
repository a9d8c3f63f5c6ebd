"""How many connections the cockpit accepts, which ones give way, and how long one may be silent."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import ssl
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import ManualClock, nanoseconds
from skyloop.cockpit import listening
from skyloop.cockpit.access import Person
from skyloop.cockpit.listening import (
    ANSWER_S,
    DESCRIPTORS_LEFT,
    HEADER_S,
    MAX_ANONYMOUS,
    MAX_KNOWN,
    NEXT_S,
    Acceptor,
    Admission,
    Connection,
    Places,
    RepeatLimit,
    places_here,
)
from skyloop.cockpit.security import ADMIT, Guard, own_names
from skyloop.messages import Role
from tests.support.cockpit import this_user

PILOT, OBSERVER = Person(Role.PILOT, "ann"), Person(Role.OBSERVER, "bob")
SMALL = Places(anonymous=6, anonymous_of_address=3, known=8, known_of_address=4)


class Hall:
    """An admission, with the connections it has ended."""

    def __init__(self, places: Places = SMALL) -> None:
        self.admission = Admission(places)
        self.ended: list[Connection] = []
        self.now_ns = 0

    def open(self, address: str = "a", person: Person | None = None) -> Connection:
        connection = Connection(address, lambda: self.ended.append(connection))
        self.admission.opened(connection, self.now_ns)
        if person is not None:
            assert self.admission.requested(connection, person, self.now_ns) == ""
        return connection

    def after(self, seconds: float) -> list[Connection]:
        self.now_ns += nanoseconds(seconds)
        self.admission.end_overdue(self.now_ns)
        return self.ended


def test_the_oldest_stranger_of_an_address_gives_way_to_a_newer_one() -> None:
    hall = Hall()
    first, *_ = (hall.open() for _ in range(4))
    assert hall.ended == [first]
    assert hall.admission.anonymous == 3
    assert hall.admission.counts.displaced == 1


def test_a_guesser_at_the_same_address_does_not_end_the_handshakes_of_people() -> None:
    """A hundred wrong tokens a second with delayed answers ended every connection of the address within 0.3 s."""
    hall = Hall()
    person = hall.open()
    for _ in range(100):
        guess = hall.open()
        assert hall.admission.requested(guess, None, hall.now_ns) == ""
    assert person not in hall.ended
    assert hall.admission.requested(person, PILOT, hall.now_ns) == ""
    assert hall.admission.anonymous == SMALL.anonymous_of_address - 1


def test_a_flood_from_one_address_ends_its_own_connections_and_no_others() -> None:
    hall = Hall()
    quiet = hall.open("quiet")
    for address in ("a", "b"):
        for _ in range(3):
            hall.open(address)
    for _ in range(100):
        hall.open("a")
    assert quiet not in hall.ended
    assert len(hall.ended) == 101
    hall.open("new")
    assert quiet not in hall.ended
    assert hall.admission.anonymous == SMALL.anonymous


def test_strangers_take_no_place_of_people_who_are_logged_in() -> None:
    hall = Hall()
    known = [hall.open("a", PILOT) for _ in range(SMALL.known_of_address)]
    for _ in range(100):
        hall.open("a")
    assert not set(known) & set(hall.ended)
    hall.open("b", PILOT)


def test_observers_leave_places_for_pilots() -> None:
    hall = Hall()
    for number in range(SMALL.observers):
        hall.open(f"address {number}", OBSERVER)
    late = hall.open("late")
    assert "observer connections" in hall.admission.requested(late, OBSERVER, 0)
    assert hall.admission.counts.refused == 1
    assert hall.after(HEADER_S) == [late]
    for number in range(SMALL.known - SMALL.observers):
        hall.open(f"pilot {number}", PILOT)
    assert "the most that this cockpit accepts" in hall.admission.requested(hall.open("z"), PILOT, 0)


def test_one_address_has_so_many_places_and_gets_them_back() -> None:
    hall = Hall()
    open_ = [hall.open("a", OBSERVER) for _ in range(SMALL.known_of_address)]
    more = hall.open("a")
    assert "4 observer connections are open from a" in hall.admission.requested(more, OBSERVER, 0)
    assert hall.admission.requested(more, PILOT, 0) == "", "a pilot's are counted by themselves"
    hall.admission.closed(open_[0])
    hall.open("a", OBSERVER)
    assert hall.admission.requested(open_[1], OBSERVER, 0) == "", "who has a place keeps it"


def test_silent_connections_are_closed() -> None:
    hall = Hall()
    silent, asked, person = hall.open(), hall.open(), hall.open("b", OBSERVER)
    hall.admission.requested(asked, None, 0)
    assert hall.after(HEADER_S - 0.1) == []
    assert hall.after(0.1) == [silent]
    assert hall.after(ANSWER_S) == [silent, asked]
    hall.admission.answered(person, hall.now_ns)
    assert hall.after(NEXT_S - 0.1) == [silent, asked], "a known one has no time to keep before it was answered"
    assert hall.after(0.1) == [silent, asked, person]
    assert hall.admission.counts.timed_out == 3


def test_shedding_without_connections_does_nothing() -> None:
    Admission().shed()


@given(st.integers(1, 1 << 20))
def test_places_leave_descriptors_for_everything_else(descriptors: int) -> None:
    places = Places.within(descriptors)
    assert places.known <= MAX_KNOWN
    assert places.anonymous <= MAX_ANONYMOUS
    assert 1 <= places.observers <= places.known
    if descriptors >= 2 * DESCRIPTORS_LEFT:
        assert places.known + places.anonymous <= descriptors - DESCRIPTORS_LEFT


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from(["open", "pilot", "observer", "close"])), max_size=80)
)
def test_the_lists_are_never_longer_than_allowed(steps: list[tuple[str, str]]) -> None:
    hall = Hall()
    open_: list[Connection] = []
    for address, what in steps:
        if what == "open":
            open_.append(hall.open(address))
        elif what == "close" and open_:
            hall.admission.closed(open_.pop())
        elif open_ and open_[-1] not in hall.ended:
            hall.admission.requested(open_[-1], PILOT if what == "pilot" else OBSERVER, 0)
        assert hall.admission.anonymous <= SMALL.anonymous
        assert hall.admission.known <= SMALL.known


# At the socket -----------------------------------------------------------------------------------------------------


class Speaker(asyncio.Protocol):
    """A handler that sends a greeting."""

    def connection_made(self, transport: Any) -> None:
        transport.write(b"hello")


def test_accepting_pauses_while_the_system_is_out_of_descriptors(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a free descriptor the cockpit retries after a while, drops a stranger's connection and logs little."""
    monkeypatch.setattr(logging.getLogger(listening.__name__), "filters", [])  # a cockpit that ran here limits repeats
    admission = Admission()
    ended = []
    idle = Connection("b", lambda: ended.append("idle"))
    admission.opened(idle, 0)
    monkeypatch.setattr(listening, "PAUSE_S", 0.001)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        real, errors = loop.sock_accept, [errno.EMFILE, errno.ECONNABORTED, errno.ENFILE]

        async def accept(sock: socket.socket) -> Any:
            if errors:
                raise OSError(errors.pop(), "none left")
            return await real(sock)

        monkeypatch.setattr(loop, "sock_accept", accept)
        with socket.socket() as bound:
            bound.bind(("127.0.0.1", 0))
            task = asyncio.create_task(Acceptor(bound, admission, lambda _: Speaker()).run())
            await asyncio.sleep(0)
            reader, writer = await asyncio.open_connection(*bound.getsockname())
            assert await reader.readexactly(5) == b"hello"
            assert admission.anonymous == 1
            next(iter(admission._anonymous["127.0.0.1"])).end()
            assert await reader.read() == b""
            writer.close()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            assert not admission.anonymous

    asyncio.run(main())
    assert ended == ["idle"]
    assert [record.message for record in caplog.records if record.name == listening.__name__] == [
        "can't accept connections: none left"
    ] * 2


def test_an_unfinished_handshake_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listening, "SWEEP_S", 0.001)
    clock, admission = ManualClock(), Admission()

    async def main() -> None:
        with socket.socket() as bound:
            bound.bind(("127.0.0.1", 0))
            tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            task = asyncio.create_task(Acceptor(bound, admission, lambda _: Speaker(), tls, clock).run())
            await asyncio.sleep(0)
            reader, writer = await asyncio.open_connection(*bound.getsockname())
            writer.write(b"\x16\x03\x01")
            while not admission.anonymous:
                await asyncio.sleep(0.001)
            clock.advance(HEADER_S)
            assert await asyncio.wait_for(reader.read(), 5) == b""
            while admission.anonymous:
                await asyncio.sleep(0.001)
            writer.close()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(main())
    assert admission.counts.timed_out == 1


def test_a_closed_listening_socket_ends_the_listener(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        async def accept(_: socket.socket) -> Any:
            raise OSError(errno.EBADF, "closed")

        monkeypatch.setattr(asyncio.get_running_loop(), "sock_accept", accept)
        with socket.socket() as bound:
            bound.bind(("127.0.0.1", 0))
            with pytest.raises(OSError, match="closed"):
                await Acceptor(bound, Admission(), lambda _: Speaker()).run()

    asyncio.run(main())


def test_this_process_has_places(monkeypatch: pytest.MonkeyPatch) -> None:
    assert places_here().known > 0
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert places_here() == Places()


def test_messages_caused_by_strangers_are_rate_limited() -> None:
    clock = ManualClock()
    limit = RepeatLimit(10.0, clock)

    def record(value: int) -> logging.LogRecord:
        return logging.LogRecord("a", logging.WARNING, "", 0, "bad: %d", (value,), None)

    assert [limit.filter(record(number)) for number in range(5)] == [True, False, False, False, False]
    clock.advance(10)
    told = record(9)
    assert limit.filter(told)
    assert told.getMessage() == "bad: 9 (4 more such messages)"


def test_messages_are_limited_however_many_different_ones_there_were() -> None:
    limit = RepeatLimit(10.0, ManualClock())

    def told(text: str) -> bool:
        return limit.filter(logging.LogRecord("a", logging.WARNING, "", 0, text, (), None))

    assert all(told(f"bad {number}") for number in range(1000))
    assert told("a new one")
    assert not told("a new one")
    assert not told("bad 999")
    assert len(limit._logged) <= 256


# In the application ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "told"), [("http", 503), ("websocket", 1013)])
def test_too_many_connections_are_refused_with_the_reason(kind: str, told: int) -> None:
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        return {"type": f"{kind}.connect"}

    async def app(*_: Any) -> None:
        raise AssertionError("it is not asked")

    headers = [(b"host", b"127.0.0.1:8123"), (b"origin", b"http://127.0.0.1:8123")]
    state = {ADMIT: lambda person: f"too many of {person.role}s"}
    scope: dict[str, Any] = {"type": kind, "method": "GET", "path": "/ws/overview", "headers": headers, "state": state}
    scope |= {"client": ("127.0.0.1", 1), "server": ("127.0.0.1", 8123)}
    guard = Guard(app, own_names("127.0.0.1", 8123), this_user())
    asyncio.run(guard(scope, receive, send))
    last = sent[-1]
    assert (sent[0]["status"] if kind == "http" else last["code"]) == told
    assert "too many of pilots" in str(last)
