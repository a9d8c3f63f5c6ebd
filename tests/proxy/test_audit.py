"""The audit trail: events become lines, lines a table, and a proxy that keeps one."""

from __future__ import annotations

import os
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from skyloop.errors import NameTakenError, UsageError
from skyloop.messages import Event, EventKind, FlightState, Land, ReleaseAuthority, RequestAuthority, Takeoff, Value
from skyloop.proxy import Proxy
from skyloop.proxy.records import AuditEntry, AuditTrail, Tenure, audit_path, entry_of, read, tenures
from skyloop.proxy.serve import keep_trail
from skyloop.transport.local import LocalServer
from tests.support.proxy_bench import Bench, FakeDriver

NOON = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)


def entry(kind: EventKind, app: str | None = None, text: str = "", **data: Value) -> AuditEntry | None:
    return entry_of(Event(kind, text, 0, app=app, data=data), NOON, "alpha", "r1")


def test_lines_for_events() -> None:
    granted = entry(EventKind.AUTHORITY_GRANTED, "alice", app_id=1, priority=4, lease=2, identity="pid 9")
    assert granted == AuditEntry(NOON, "alpha", "r1", "granted", "alice", "pid 9", 2, 4)
    lost = entry(EventKind.AUTHORITY_LOST, "alice", app_id=1, lease=2, reason="silent", by="")
    assert lost == AuditEntry(NOON, "alpha", "r1", "ended", "alice", lease=2, how="silent")
    taken = entry(EventKind.AUTHORITY_PREEMPTED, "alice", lease=2, by="bob", granted=False)
    assert taken is not None
    assert taken.how == "taken over by bob"
    given = entry(EventKind.AUTHORITY_PREEMPTED, "alice", lease=2, by="bob", granted=True)
    assert given is not None
    assert given.how == "handed over to bob"
    stopped = entry(EventKind.EMERGENCY, "bob", "emergency stop by bob")
    assert stopped == AuditEntry(NOON, "alpha", "r1", "emergency", "bob", how="emergency stop by bob")
    assert entry(EventKind.PROXY_CLOSING, None, "it ends") == AuditEntry(NOON, "alpha", "r1", "end", how="it ends")
    assert entry(EventKind.BATTERY_LOW, battery=0.1) is None


@pytest.mark.parametrize(
    ("before", "after", "what"),
    [
        ("landed", "taking_off", "takeoff"),
        ("landed", "flying", "takeoff"),
        ("taking_off", "hovering", None),
        ("landing", "landed", "landed"),
        ("flying", "emergency", "landed"),
        ("unknown", "hovering", None),  # a vehicle that was already flying when the proxy started
        ("landed", "emergency", None),
        ("landed", "levitating", None),
        ("landed", 3, None),
    ],
)
def test_which_changes_count_as_a_take_off(before: str, after: Value, what: str | None) -> None:
    line = entry(EventKind.STATE_CHANGED, before=before, after=after)
    assert (line.what if line else None) == what


def test_the_table() -> None:
    at = [NOON + timedelta(minutes=minute) for minute in range(12)]
    lines = [
        AuditEntry(at[0], "alpha", "r1", "begin", how="sim://"),
        AuditEntry(at[1], "alpha", "r1", "granted", "alice", "pid 9", 1, 16),
        AuditEntry(at[1], "bravo", "x1", "takeoff"),  # before anyone held it
        AuditEntry(at[2], "alpha", "r1", "takeoff"),
        AuditEntry(at[2], "bravo", "x1", "granted", "carol", "pid 7", 1, 0),
        AuditEntry(at[3], "alpha", "r1", "landed"),
        AuditEntry(at[4], "alpha", "r1", "takeoff"),
        AuditEntry(at[5], "alpha", "r1", "ended", "alice", lease=1, how="taken over by bob"),
        AuditEntry(at[5], "alpha", "r1", "granted", "bob", "pid 8", 2, 4),
        AuditEntry(at[6], "alpha", "r1", "end", how="it ends"),
        AuditEntry(at[7], "alpha", "r2", "begin"),
        AuditEntry(at[8], "alpha", "r2", "granted", "alice", "pid 9", 1, 16),
        AuditEntry(at[9], "alpha", "r3", "begin"),
        AuditEntry(at[10], "alpha", "r3", "granted", "dave", "pid 6", 1, 16),
    ]
    assert tenures(lines) == [
        Tenure("alpha", "alice", "pid 9", 16, at[1], at[5], "taken over by bob", 2),
        Tenure("bravo", "carol", "pid 7", 0, at[2], None, ""),
        Tenure("alpha", "bob", "pid 8", 4, at[5], at[6], "the proxy ended"),
        Tenure("alpha", "alice", "pid 9", 16, at[8], None, "the proxy was killed"),
        Tenure("alpha", "dave", "pid 6", 16, at[10], None, ""),
    ]


def test_a_proxy_keeps_its_trail_and_appends_to_the_previous_one(tmp_path: Path) -> None:
    path = tmp_path / "state" / "bench.jsonl"
    for run in ("r1", "r2"):
        bench = Bench()
        bench.proxy.keep_trail(AuditTrail(path, "bench", run, lambda: NOON))
        with bench:
            alice, bob = bench.pilot("alice"), bench.join("bob")
            alice.command(Takeoff())
            bench.driver.report(state=FlightState.HOVERING)
            bob.ask(RequestAuthority(4))
            bob.ask(ReleaseAuthority())
            alice.lease = int(alice.told(EventKind.AUTHORITY_GRANTED)[-1].data["lease"])  # type: ignore[arg-type]
            alice.command(Land())
            bench.driver.report(state=FlightState.LANDED)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    entries, bad = read(path)
    assert bad == 0
    story = [(each.what, each.who, each.how) for each in entries if each.run == "r2"]
    assert story == [
        ("begin", "", "fake://"),
        ("granted", "alice", ""),
        ("takeoff", "", ""),
        ("ended", "alice", "taken over by bob"),
        ("granted", "bob", ""),
        ("ended", "bob", "released"),
        ("granted", "alice", ""),
        ("landed", "", ""),
        ("end", "", "proxy bench ends: the proxy was stopped"),
    ]
    assert [row.who for row in tenures(entries)] == ["alice", "bob", "alice"] * 2
    assert [row.identity for row in tenures(entries)] == ["this process"] * 6


def test_a_torn_line_is_skipped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    trail = AuditTrail(path, "alpha", "r1", lambda: NOON)
    trail.begin("sim://")
    trail.close()
    with path.open("ab") as file:
        file.write(b'{"at":"2026-05-04T12:00:00Z","pro')
    entries, bad = read(path)
    assert [each.what for each in entries] == ["begin"]
    assert bad == 1
    with pytest.raises(UsageError, match="can't be read: No such file"):
        read(tmp_path / "b.jsonl")


def test_a_full_disk_is_reported_once(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full here")
    trail = AuditTrail(Path("/dev/full"), "alpha", "r1")
    for _ in range(3):
        trail.begin("sim://")
    trail.close()
    assert caplog.text.count("can't be written: [Errno 28]") == 1


def test_the_default_folder_may_be_missing_but_a_requested_one_may_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "state").write_text("not a directory")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    bench = Bench()
    keep_trail(bench.proxy, None)
    assert "there is no audit trail" in caplog.text
    with pytest.raises(UsageError, match="can't be written"):
        keep_trail(bench.proxy, tmp_path / "state" / "mine.jsonl")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    assert audit_path("alpha") == tmp_path / "other" / "skyloop" / "audit" / "alpha.jsonl"


def test_a_proxy_that_never_served_leaves_no_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    path = tmp_path / "alpha.jsonl"
    bench = Bench()
    first = Proxy(FakeDriver(bench.clock), LocalServer("alpha"), name="alpha")
    second = Proxy(FakeDriver(bench.clock), LocalServer("alpha"), name="alpha")
    with first:
        second.keep_trail(AuditTrail(path, "alpha", "r2"))
        with pytest.raises(NameTakenError):
            second.start()
    assert read(path) == ([], 0)
    assert os.access(path, os.R_OK)
