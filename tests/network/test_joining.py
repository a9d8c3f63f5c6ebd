"""Answers to an application that wants to join, from ends other than the intended proxy."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

pytest.importorskip("zenoh", reason="needs the extra network: skyloop install network")

from skyloop.errors import LinkError, NoAnswerError, UnknownNameError
from skyloop.network import client, discovery, layout, packets
from skyloop.network.admission import JoinRequest
from skyloop.network.config import FabricSettings
from skyloop.network.discovery import ProxyWatch, join
from skyloop.network.session import FabricSession
from skyloop.transport.testing import ClientLog

RUN, OTHER = "1" * 16, "2" * 16
ABOUT = packets.ProxyInfo("alpha", RUN, 0, "host", 7, "sim://", "fabric:alpha")


class Payload(bytes):
    def to_string(self) -> str:
        return self.decode()


def answered(payload: bytes) -> Any:
    return SimpleNamespace(err=None, ok=SimpleNamespace(payload=Payload(payload)))


def welcome(run: str) -> Any:
    return answered(packets.encode_own(packets.Welcome(packets.REVISION, run)))


def session(*replies: Any) -> FabricSession:
    settings = SimpleNamespace(who="anyone", ring=None, tls=None)
    return cast(
        "FabricSession", SimpleNamespace(settings=settings, zenoh=SimpleNamespace(get=lambda *_, **__: replies))
    )


def test_answers_of_others_are_skipped() -> None:
    strangers = (answered(b"\xc1 nonsense"), answered(bytes(packets.MAX_OWN + 1)), welcome(OTHER))
    with pytest.raises(NoAnswerError, match="found on the network but did not answer"):
        join(session(*strangers), "alpha", RUN, layout.new_id())
    assert join(session(*strangers, welcome(RUN)), "alpha", RUN, layout.new_id()) is not None


def test_a_refusal_is_raised_with_its_reason() -> None:
    refused = SimpleNamespace(err=SimpleNamespace(payload=Payload(b"it is full")), ok=None)
    with pytest.raises(LinkError, match="does not admit us: it is full"):
        join(session(refused), "alpha", RUN, layout.new_id())


def test_a_timed_out_answer_is_not_a_refusal() -> None:
    """A router answers a timed-out query with an error; the application must ask again."""
    late = SimpleNamespace(err=SimpleNamespace(payload=Payload(b"Timeout")), ok=None)
    with pytest.raises(NoAnswerError, match="found on the network but did not answer"):
        join(session(late), "alpha", RUN, layout.new_id())
    assert join(session(late, welcome(RUN)), "alpha", RUN, layout.new_id()) is not None


def test_an_impostor_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def accept(_request: JoinRequest, _welcome: packets.Welcome) -> None:
        raise LinkError("its proof is wrong")

    monkeypatch.setattr(JoinRequest, "accept", accept)
    with pytest.raises(LinkError, match="an impostor answers as the proxy 'alpha': its proof is wrong"):
        join(session(welcome(RUN)), "alpha", RUN, layout.new_id())


@pytest.mark.parametrize(("complete", "error"), [(True, UnknownNameError), (False, NoAnswerError)])
def test_an_unknown_name_differs_from_an_incomplete_list(
    complete: bool, error: type[LinkError], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def listed(_session: FabricSession, *, within_s: float) -> tuple[set[tuple[str, str]], bool]:
        asked.append(within_s)
        return {("bravo", OTHER)}, complete

    monkeypatch.setattr(discovery, "listed", listed)
    there = cast("FabricSession", SimpleNamespace(settings=FabricSettings()))
    with pytest.raises(error):
        ProxyWatch(there, "alpha", lambda _: None).find(0.0, 0.5)
    assert asked == [0.5]


@pytest.mark.parametrize("runs", [{RUN}, {OTHER}, {RUN, OTHER}])
def test_a_known_proxy_is_not_asked_again_unless_there_is_a_choice(
    runs: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def oldest_first(_session: FabricSession, name: str) -> list[packets.ProxyInfo]:
        asked.append(name)
        return []

    monkeypatch.setattr(discovery, "oldest_first", oldest_first)
    watch = ProxyWatch(
        cast("FabricSession", SimpleNamespace(settings=FabricSettings())), "alpha", lambda _: None, ABOUT
    )
    watch._runs = runs
    found = watch.find(0.0, 0.5)
    assert found == ([(RUN, ABOUT)] if runs == {RUN} else [(min(runs), None)])
    assert bool(asked) == (runs != {RUN})


def test_a_silent_node_soon_gets_another_session_and_more_time_each_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[float] = []
    retired: list[object] = []
    reached = True

    def connection(
        session: FabricSession,
        _name: str,
        _handler: object,
        _find_s: float,
        list_s: float,
        known: packets.ProxyInfo | None,
    ) -> Any:
        given.append(list_s)
        assert known == (ABOUT if len(given) > 1 else None), "it is not asked for its description again"
        if not reached:
            raise NoAnswerError("no answer")
        return SimpleNamespace(parted=True, session=session, about=ABOUT if len(given) == 1 else None)

    monkeypatch.setattr(client, "FabricClient", connection)
    monkeypatch.setattr(client, "acquire", lambda *_: object())
    monkeypatch.setattr(client, "release", lambda _: None)
    monkeypatch.setattr(client, "retire", retired.append)
    dialer = client.dial("alpha", FabricSettings(multicast=False))
    dialer(ClientLog())
    reached = False
    for _ in range(4):
        with pytest.raises(NoAnswerError):
            dialer(ClientLog())
    assert len(set(retired)) == 4
    reached = True
    dialer(ClientLog())
    dialer(ClientLog())
    assert given == [5.0, 1.0, 2.0, 4.0, 5.0, 5.0, 1.0]
