"""Workers of processors: shares of the frames, and relayed results."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import (
    Done,
    EventKind,
    GetStatistics,
    JoinProcessor,
    ProcessorResult,
    ProcessorShare,
    Refusal,
    Refused,
    Role,
    Statistics,
    encode,
)
from skyloop.messages.relayed import pack
from skyloop.proxy.relay import MAX_JOINED, SILENT_S, WorkerRoster
from skyloop.transport.base import RESULTS, results
from tests.support.proxy_bench import App, Bench

CODE = "Detector 0123"


def asked(processor: str = "detector", code: str = CODE, camera: str = "front", **fields: bool) -> JoinProcessor:
    return JoinProcessor(processor, code, camera, **fields)


def result(processor: str = "detector", number: int = 1, worker: int = 99) -> ProcessorResult:
    return ProcessorResult(processor, "front", 5, 100, 200, 50, number, pack({"x": 1}), worker)


def worker(bench: Bench, name: str) -> App:
    app = bench.join(name, Role.OBSERVER)
    assert app.ask(asked()) == Done()
    return app


def shares(app: App) -> list[tuple[int, int, int]]:
    app.sync()
    return [(one.part, one.parts, one.workers) for one in app.others if isinstance(one, ProcessorShare)]


def states(app: App) -> list[tuple[str, str]]:
    return [(str(event.app), str(event.data["state"])) for event in app.told(EventKind.PROCESSOR)]


def test_shares_are_sent_as_workers_come_and_go(bench: Bench) -> None:
    eye, one = bench.join("eye"), worker(bench, "one")
    assert shares(one) == [(0, 1, 1)]
    two = worker(bench, "two")
    assert shares(two) == [(1, 2, 2)]
    assert shares(one)[-1] == (0, 2, 2)
    one.end.close()
    two.sync()
    assert shares(two)[-1] == (0, 1, 1)
    assert states(eye) == [("one", "joined"), ("two", "joined"), ("one", "left")]


def test_a_renewal_repeats_the_share_without_an_event(bench: Bench) -> None:
    one = worker(bench, "one")
    for _ in range(3):
        bench.run(SILENT_S / 2)
        assert one.ask(asked()) == Done()
    assert shares(one) == [(0, 1, 1)] * 4
    assert states(one) == [("one", "joined")]


def test_a_silent_worker_loses_its_share_until_it_returns(bench: Bench) -> None:
    eye, one, two = bench.join("eye"), worker(bench, "one"), worker(bench, "two")
    bench.run(2 * SILENT_S, each=lambda: two.ask(asked()))
    assert shares(two)[-1] == (0, 1, 2)
    assert shares(one)[-1] == (0, 0, 2)
    assert one.ask(asked()) == Done()
    assert shares(one)[-1] == (0, 2, 2)
    assert shares(two)[-1] == (1, 2, 2)
    assert states(eye)[2:] == [("one", "silent"), ("one", "back")]


def test_a_busy_worker_gives_its_share_to_the_others(bench: Bench) -> None:
    eye, one, two = bench.join("eye"), worker(bench, "one"), worker(bench, "two")
    assert one.ask(asked(ready=False)) == Done()
    assert (shares(one)[-1], shares(two)[-1]) == ((0, 0, 2), (0, 1, 2))
    assert one.ask(asked(ready=False)) == Done()
    assert one.ask(asked()) == Done()
    assert (shares(one)[-1], shares(two)[-1]) == ((0, 2, 2), (1, 2, 2))
    assert states(eye)[2:] == [("one", "busy"), ("one", "back")]


def test_all_workers_get_all_frames_if_chosen(bench: Bench) -> None:
    apps = [bench.join(name) for name in ("one", "two")]
    for app in apps:
        assert app.ask(asked(shared=False)) == Done()
    assert [shares(app)[-1] for app in apps] == [(0, 1, 2), (0, 1, 2)]


def test_cameras_are_shared_separately(bench: Bench) -> None:
    one, two = bench.join("one"), bench.join("two")
    assert bench.driver.sink is not None
    bench.driver.sink.frame("bottom", np.zeros(3, np.uint8), 1, width=1, height=1)
    one.ask(asked(camera="front"))
    two.ask(asked(camera="bottom"))
    assert (shares(one), shares(two)) == ([(0, 1, 1)], [(0, 1, 1)])


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (
            asked(code="Finder 9"),
            "runs other code under the name detector: Detector 0123, this one runs Finder 9; use an",
        ),
        (
            asked(shared=False),
            "works for detector and shares the frames, while this one takes all frames: all its workers",
        ),
    ],
)
def test_one_name_has_one_code_and_one_way_to_share(bench: Bench, other: JoinProcessor, words: str) -> None:
    one, two = worker(bench, "one"), bench.join("two")
    refused = two.ask(other)
    assert isinstance(refused, Refused)
    assert refused.code is Refusal.NAME_TAKEN
    assert f"one (application {one.app_id})" in refused.message
    assert words in refused.message
    one.end.close()
    two.sync()
    assert two.ask(other) == Done()


def test_one_application_works_for_only_a_few_processors(bench: Bench) -> None:
    app = bench.join("one")
    for number in range(MAX_JOINED):
        assert app.ask(asked(f"p{number}")) == Done()
    refused = app.ask(asked("more"))
    assert isinstance(refused, Refused)
    assert refused.code is Refusal.BUSY
    assert app.ask(asked("p0")) == Done()


def test_results_of_workers_are_relayed_under_their_own_number(bench: Bench) -> None:
    eye, one = bench.join("eye"), worker(bench, "one")
    eye.end.subscribe(results("detector"))
    eye.sync()
    assert one.end.send(encode(result(worker=77)))
    one.sync()
    eye.sync()
    [came] = [sample for sample in eye.others if isinstance(sample, ProcessorResult)]
    assert came == result(worker=one.app_id)
    eye.end.subscribe(RESULTS)
    eye.sync()
    assert one.end.send(encode(result(number=2)))
    one.sync()
    eye.sync()
    assert sum(isinstance(sample, ProcessorResult) for sample in eye.others) == 3  # on either topic


def test_results_of_non_workers_are_refused_and_reported(bench: Bench) -> None:
    eye, one = bench.join("eye"), worker(bench, "one")
    eye.end.subscribe(RESULTS)
    for _ in range(5):
        assert one.end.send(encode(result("finder")))
    one.sync()
    assert not [sample for sample in eye.others if isinstance(sample, ProcessorResult)]
    assert states(eye)[1:] == [("one", "refused")]
    counters = one.ask(GetStatistics())
    assert isinstance(counters, Statistics)
    assert counters.counters["results.refused"] == 5
    assert "results.relayed" not in counters.counters


def test_nothing_is_accepted_before_hello(bench: Bench) -> None:
    stranger, eye = bench.stranger(), bench.join("eye")
    refused = stranger.ask(asked())
    assert isinstance(refused, Refused)
    assert refused.code is Refusal.PROTOCOL
    assert stranger.end.send(encode(result()))
    stranger.ask(asked())  # the answer comes after earlier packets have been handled
    told = eye.told(EventKind.PACKET_MALFORMED)
    assert "a result arrived before Hello" in told[0].text


def test_only_the_proxy_may_send_shares(bench: Bench) -> None:
    app = bench.join("one")
    assert app.end.send(encode(ProcessorShare("detector", "front", 0, 1, 1)))
    assert "ProcessorShare may only be sent by the proxy" in app.told(EventKind.PACKET_MALFORMED)[0].text


# The roster ----------------------------------------------------------------------------------------------------

EVENTS = st.lists(
    st.tuples(st.sampled_from(["join", "busy", "leave", "wait"]), st.integers(1, 6)), min_size=1, max_size=30
)


def owners(roster: WorkerRoster, apps: Iterable[int], seq: int) -> list[int]:
    shared_out = roster.shares()
    return [
        app
        for app in apps
        if (share := shared_out.get((app, "detector"))) and share.parts and seq % share.parts == share.part
    ]


@given(EVENTS)
def test_each_frame_has_exactly_one_worker_while_any_can_work(events: list[tuple[str, int]]) -> None:
    roster, now_ns = WorkerRoster(), 0
    working: dict[int, tuple[bool, int]] = {}
    for what, app in events:
        now_ns += 10**8
        if what == "leave":
            roster.remove(app)
            working.pop(app, None)
        elif what == "wait":
            now_ns += 4 * 10**8
        else:
            roster.register(app, asked(ready=what == "join"), now_ns)
            working[app] = (what == "join", now_ns)
        roster.mark_silent(now_ns)
        able = [app for app, (ready, heard) in working.items() if ready and now_ns - heard <= SILENT_S * 1e9]
        for seq in range(12):
            found = owners(roster, range(1, 7), seq)
            assert len(found) == (1 if able else 0)
            assert set(found) <= set(able)
