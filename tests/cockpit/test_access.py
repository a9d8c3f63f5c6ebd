"""Tokens, certificates, and the owner of the program at the other end."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some

from skyloop.clock import ManualClock
from skyloop.cockpit.access import (
    CERTIFICATE,
    MAX_SESSIONS,
    SESSION_S,
    CertificateGate,
    OpenGate,
    Pairing,
    Person,
    SessionFile,
    Token,
    TokenGate,
    peer_uid,
    person_of,
    read_tokens,
    uid_in,
)
from skyloop.errors import FileFormatError, UsageError
from skyloop.messages import Role
from tests.support.systems import has_modes, only_on

ANN = Token(Person(Role.PILOT, "ann"), b"0123456789abcdef")
BOB = Token(Person(Role.OBSERVER), b"fedcba9876543210")

HEAD = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n"


def entry(local: str, remote: str, uid: int = 1000, inode: int = 4711, state: str = "01") -> str:
    return f"   0: {local} {remote} {state} 00000000:00000000 00:00000000 00000000  {uid}        0 {inode} 1 0\n"


def test_roles() -> None:
    pilot, observer = Person(Role.PILOT), Person(Role.OBSERVER)
    assert pilot.may(Role.PILOT)
    assert pilot.may(Role.OBSERVER)
    assert observer.may(Role.OBSERVER)
    assert not observer.may(Role.PILOT)


# The file of tokens ------------------------------------------------------------------------------------------------


def written(folder: Path, text: str, mode: int = 0o600) -> Path:
    path = folder / "tokens"
    path.write_text(text)
    path.chmod(mode)
    return path


def test_tokens_are_read(tmp_path: Path) -> None:
    path = written(tmp_path, "# who may\n\npilot 0123456789abcdef  Ann B. \nobserver fedcba9876543210\n")
    tokens = read_tokens(path)
    assert [token.person for token in tokens] == [Person(Role.PILOT, "Ann B."), Person(Role.OBSERVER, "")]
    assert tokens[0].secret == b"0123456789abcdef"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no token"),
        ("# nothing\n", "has no token"),
        ("pilot\n", "line 1: expected ROLE TOKEN"),
        ("\nadmin 0123456789abcdef\n", "line 2: expected ROLE TOKEN"),
        ("pilot short\n", "16 to 256 ASCII characters"),
        ("pilot " + "x" * 257, "16 to 256 ASCII characters"),
        ("pilot " + "ä" * 20, "16 to 256 ASCII characters"),
        ("pilot 0123456789abcdef\nobserver 0123456789abcdef\n", "line 2: this token is already in the file"),
    ],
)
def test_invalid_token_files_are_reported(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(FileFormatError, match=said):
        read_tokens(written(tmp_path, text))


@has_modes
@pytest.mark.parametrize("mode", [0o644, 0o640, 0o606])
def test_a_file_that_others_may_read_is_refused(tmp_path: Path, mode: int) -> None:
    with pytest.raises(UsageError, match="chmod 600"):
        read_tokens(written(tmp_path, "pilot 0123456789abcdef\n", mode))


def test_a_missing_or_binary_token_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="can't be read"):
        read_tokens(tmp_path / "nowhere")
    path = written(tmp_path, "")
    path.write_bytes(b"\xff\xfe\xff")
    with pytest.raises(UsageError, match="can't be read"):
        read_tokens(path)


# Sessions ----------------------------------------------------------------------------------------------------------


def scope(**headers: str) -> dict[str, Any]:
    return {"headers": [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]}


def test_a_token_with_each_request() -> None:
    gate = TokenGate([ANN, BOB], "c")
    assert gate.person(scope(authorization="Bearer 0123456789abcdef")) == ANN.person
    assert gate.person(scope(authorization="bearer fedcba9876543210")) == BOB.person
    for wrong in ("Basic 0123456789abcdef", "0123456789abcdef", "Bearer", "Bearer ", "Bearer 0123456789abcdeg"):
        assert gate.person(scope(authorization=wrong)) is None
    two = {"headers": [(b"authorization", b"Bearer 0123456789abcdef")] * 2}
    assert gate.person(two) is None, "two of them are none"


@given(some.text(max_size=300))
def test_an_invalid_token_admits_no_one(text: str) -> None:
    gate = TokenGate([ANN, BOB], "c")
    assert gate.known(text) is None or text.encode() in (ANN.secret, BOB.secret)


def test_a_session_lasts_for_its_time() -> None:
    clock = ManualClock()
    gate = TokenGate([ANN], "c", clock)
    cookie = gate.begin(ANN.person)
    assert gate.person(scope(cookie=f"x=1; c={cookie}")) == ANN.person
    assert gate.person(scope(cookie=f"d={cookie}")) is None
    assert gate.person(scope(cookie=f"c={cookie}x")) is None
    assert gate.person(scope(cookie="c=")) is None
    clock.advance(SESSION_S - 1)
    assert gate.person(scope(cookie=f"c={cookie}")) == ANN.person
    clock.advance(2)
    assert gate.person(scope(cookie=f"c={cookie}")) is None


def test_a_session_can_be_ended_and_there_are_not_too_many() -> None:
    gate = TokenGate([ANN], "c")
    first, second = gate.begin(ANN.person), gate.begin(ANN.person)
    gate.end(scope(cookie=f"c={first}"))
    assert gate.person(scope(cookie=f"c={first}")) is None
    assert gate.person(scope(cookie=f"c={second}")) == ANN.person
    for _ in range(MAX_SESSIONS):
        newest = gate.begin(ANN.person)
    assert gate.person(scope(cookie=f"c={second}")) is None, "the oldest made room"
    assert gate.person(scope(cookie=f"c={newest}")) == ANN.person


@has_modes
def test_sessions_survive_a_restart_while_their_token_is_valid(tmp_path: Path) -> None:
    def gate(*tokens: Token, boot: str = "one", pairing: Pairing | None = None) -> TokenGate:
        return TokenGate(tokens, "c", pairing=pairing, kept=SessionFile(tmp_path / "sessions", boot))

    first = gate(ANN, BOB, pairing=Pairing(Role.PILOT))
    ann, bob = (first.begin(one.person, one.secret.decode()) for one in (ANN, BOB))
    paired, ended = first.begin(Person(Role.PILOT, "paired"), "code"), first.begin(ANN.person, ANN.secret.decode())
    first.end(scope(cookie=f"c={ended}"))
    text = (tmp_path / "sessions").read_text()
    assert not any(secret in text for secret in (ann, bob, paired, ANN.secret.decode()))
    assert stat.S_IMODE((tmp_path / "sessions").stat().st_mode) == 0o600

    def let_in(again: TokenGate) -> list[bool]:
        return [again.person(scope(cookie=f"c={cookie}")) is not None for cookie in (ann, bob, paired, ended)]

    assert let_in(gate(ANN, BOB, pairing=Pairing(Role.PILOT))) == [True, True, True, False]
    assert let_in(gate(BOB)) == [False, True, False, False], "a token that was taken out of the file, and no pairing"
    assert let_in(gate(ANN, pairing=Pairing(Role.OBSERVER))) == [True, False, False, False], "another role than it had"
    assert let_in(gate(ANN, BOB, boot="two")) == [False] * 4, "times of before the machine was started"
    (tmp_path / "sessions").chmod(0o644)
    assert let_in(gate(ANN, BOB)) == [False] * 4, "others could have read it"
    (tmp_path / "sessions").write_bytes(b"{}")
    assert let_in(gate(ANN, BOB)) == [False] * 4


def test_sessions_that_cannot_be_saved_last_until_the_process_ends(tmp_path: Path) -> None:
    gate = TokenGate([ANN], "c", kept=SessionFile(tmp_path / "gone" / "sessions"))
    cookie = gate.begin(ANN.person, ANN.secret.decode())
    assert gate.person(scope(cookie=f"c={cookie}")) == ANN.person


# Certificates ------------------------------------------------------------------------------------------------------


def certificate(*subject: tuple[str, str]) -> dict[str, Any]:
    return {"subject": tuple((pair,) for pair in subject)}


@pytest.mark.parametrize(
    ("told", "person"),
    [
        (certificate(("organizationalUnitName", "pilot"), ("commonName", "Ann")), Person(Role.PILOT, "Ann")),
        (certificate(("organizationalUnitName", "Observer")), Person(Role.OBSERVER, "")),
        (certificate(("organizationalUnitName", "lab"), ("organizationalUnitName", "pilot")), Person(Role.PILOT)),
        (certificate(("organizationalUnitName", "observer"), ("organizationalUnitName", "pilot")), None),
        (certificate(("organizationalUnitName", "admin"), ("commonName", "pilot")), None),
        (certificate(("commonName", "pilot")), None),
        ({}, None),
        (None, None),
    ],
)
def test_the_unit_of_a_certificate_is_the_role(told: dict[str, Any] | None, person: Person | None) -> None:
    assert person_of(told) == person
    assert CertificateGate().person({"state": {CERTIFICATE: told}}) == person
    assert CertificateGate().person({}) is None


# Whose program ------------------------------------------------------------------------------------------------------


def test_the_table_of_sockets() -> None:
    table = HEAD + entry("0100007F:1F90", "0100007F:D431", 0) + entry("0100007F:D431", "0100007F:1F90", 1001)
    assert uid_in(table, ("127.0.0.1", 0xD431), ("127.0.0.1", 0x1F90)) == 1001, "the client's end, not the server's"
    assert uid_in(table, ("127.0.0.1", 0xD432), ("127.0.0.1", 0x1F90)) is None
    assert uid_in(table, ("127.0.0.2", 0xD431), ("127.0.0.1", 0x1F90)) is None
    assert uid_in("", ("127.0.0.1", 1), ("127.0.0.1", 2)) is None
    assert uid_in(HEAD + "cut off\n", ("127.0.0.1", 1), ("127.0.0.1", 2)) is None


def test_a_closed_socket_has_no_owner() -> None:
    """The table lists it as the superuser's: a stranger who sends and hangs up must not pass for that."""
    table = HEAD + entry("0100007F:D431", "0100007F:1F90", 0, inode=0, state="04")
    assert uid_in(table, ("127.0.0.1", 0xD431), ("127.0.0.1", 0x1F90)) is None


def test_addresses_of_the_other_family() -> None:
    mapped = "0000000000000000FFFF00000100007F"
    table = HEAD + entry(f"{mapped}:D431", f"{mapped}:1F90", 7)
    assert uid_in(table, ("127.0.0.1", 0xD431), ("127.0.0.1", 0x1F90)) == 7
    loopback = "00000000000000000000000001000000"
    assert uid_in(HEAD + entry(f"{loopback}:0001", f"{loopback}:0002", 8), ("::1", 1), ("::1", 2)) == 8


@only_on("linux", reason="reads the tables in /proc/net")
@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_the_kernel_identifies_the_caller(family: socket.AddressFamily) -> None:
    host = "127.0.0.1" if family == socket.AF_INET else "::1"
    with socket.create_server((host, 0), family=family) as server:
        here = server.getsockname()[:2]
        with socket.create_connection(here) as client:
            there = client.getsockname()[:2]
            assert peer_uid(there, here) == os.geteuid()
        assert peer_uid(there, here) is None


@only_on("linux", "darwin", reason="users have no numbers there")
def test_only_this_user_and_the_superuser_are_admitted() -> None:
    asked: list[Any] = []

    def uid_of(client: tuple[str, int], server: tuple[str, int]) -> int | None:
        asked.append((client, server))
        return answers.pop()

    gate = OpenGate(Role.OBSERVER, uid_of)
    ends = {"client": ["127.0.0.1", 5], "server": ("127.0.0.1", 8123)}
    answers: list[int | None] = [None, 12345, 0, os.geteuid()]
    assert [gate.person(ends) for _ in range(4)] == [Person(Role.OBSERVER)] * 2 + [None] * 2
    assert asked[0] == (("127.0.0.1", 5), ("127.0.0.1", 8123))
    assert gate.person({"client": None, "server": None}) is None
