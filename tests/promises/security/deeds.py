"""The attempts of an intruder, and how to see that one worked."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from itertools import count
from typing import Any, NamedTuple

import numpy as np
import zenoh

from skyloop.errors import LinkError
from skyloop.messages import (
    Command,
    EmergencyStop,
    Encoding,
    Event,
    EventKind,
    Feedback,
    FrameHeader,
    GetParameter,
    Reply,
    RequestAuthority,
    SetParameter,
    Velocity,
    decode,
    encode,
)
from skyloop.messages.config import ParameterValue
from skyloop.network import discovery, layout, packets
from skyloop.network.admission import JoinRequest
from skyloop.network.config import Part
from skyloop.network.keys.agreement import Agreement
from skyloop.network.sealing import Seal
from skyloop.network.session import FabricSession, acquire, release
from skyloop.transport.base import EVENTS, FEEDBACK
from tests.promises.security.rig import DRONE, Intruder, Rig

LIAR = "f" * 16  #: RUN of an impostor's proxy
PUSH = Velocity(0.111)  #: a command that no other client sends
LIE = 0.123  #: a battery that the vehicle never reports
PARAMETER = "limits.tilt"
TILT = 0.0567
_NUMBERS = count(10**6)


class Deed(NamedTuple):
    """An attempt. ``done`` returns whether it has had any effect so far."""

    what: str
    do: Callable[[Rig, Intruder], None]
    done: Callable[[Rig, Intruder], bool]


def _command(rig: Rig, action: Velocity | EmergencyStop) -> Command:
    """Recent, newer than all of jane's and all earlier attempts', and with her lease."""
    number = next(_NUMBERS)
    return Command(number, rig.jane.lease, number, rig.bench.clock(), action)


def _of_jane(rig: Rig) -> dict[str, str]:
    return {"who": rig.who("jane"), "connection": rig.connection_of(rig.jane)}


def _fly_in_janes_name(rig: Rig, intruder: Intruder) -> None:
    intruder.send(layout.COMMAND, _command(rig, PUSH), **_of_jane(rig))


def _pushed(rig: Rig, _: Intruder) -> bool:
    return PUSH in rig.bench.driver.told


def _request_authority(rig: Rig, intruder: Intruder) -> None:
    intruder.join()
    intruder.request(layout.ORDER, RequestAuthority(0))


def _has_authority(rig: Rig, _: Intruder) -> bool:
    holder = rig.bench.proxy.handler.authority.holder
    return holder is None or holder.app_id != rig.jane.app_id


def _write_in_janes_name(rig: Rig, intruder: Intruder) -> None:
    intruder.request(layout.ORDER, SetParameter(PARAMETER, TILT, rig.jane.lease), **_of_jane(rig))


def _written(rig: Rig, _: Intruder) -> bool:
    return rig.bench.proxy.parameters.get(PARAMETER).value == TILT


def _stop_motors(rig: Rig, intruder: Intruder) -> None:
    intruder.join()
    intruder.send(layout.COMMAND, _command(rig, EmergencyStop()))


def _stopped(rig: Rig, _: Intruder) -> bool:
    return EmergencyStop() in rig.bench.driver.told


def _number(rig: Rig) -> bytes:
    return packets.published(rig.run_bytes(), 10**6)


def _false_feedback(rig: Rig, intruder: Intruder) -> None:
    intruder.see()
    intruder.put(
        layout.topic(DRONE, FEEDBACK), encode(Feedback(captured_ns=rig.bench.clock(), battery=LIE)), _number(rig)
    )


def _fooled(rig: Rig, _: Intruder) -> bool:
    return any(feedback.battery == LIE for feedback in rig.wendy.feedback)


def _lie(rig: Rig) -> Event:
    return Event(EventKind.EMERGENCY, "a lie", rig.bench.clock())


def _false_event(rig: Rig, intruder: Intruder) -> None:
    intruder.see()
    intruder.put(layout.topic(DRONE, EVENTS), encode(_lie(rig)), _number(rig))


def _alarmed(rig: Rig, _: Intruder) -> bool:
    return any(event.text == "a lie" for event in rig.wendy.events)


def _false_picture(rig: Rig, intruder: Intruder) -> None:
    intruder.see()
    header = FrameHeader("front", 10**6, 1, 1, 2, 2, Encoding.MONO8, 4)
    intruder.put(layout.video(DRONE, "front"), b"LIE!", packets.frame(rig.run_bytes(), 10**6, encode(header)))


def _shown(rig: Rig, _: Intruder) -> bool:
    return any(pixels == b"LIE!" for _, pixels in rig.wendy.frames)


def _false_answer(rig: Rig, intruder: Intruder) -> None:
    intruder.put(layout.to(DRONE, rig.connection_of(rig.jane)), encode(_lie(rig)))


def _answered(rig: Rig, _: Intruder) -> bool:
    return any(event.text == "a lie" for event in rig.jane.events)


def _as_wendy(rig: Rig, see: Callable[[FabricSession], bool]) -> bool:
    session = acquire(rig.settings("wendy"), Part.APP)
    try:
        return see(session)
    finally:
        release(session)


def _stand_in(rig: Rig, intruder: Intruder) -> None:
    about = packets.encode_own(packets.ProxyInfo(DRONE, "f" * 16, 0, "a lie", 1, "", ""))
    key = layout.info(DRONE)
    intruder.held.append(intruder.session.declare_queryable(key, lambda query: query.reply(key, about)))


def _stands_in(rig: Rig, _: Intruder) -> bool:
    return _as_wendy(
        rig, lambda session: any(about.host == "a lie" for about in discovery.oldest_first(session, DRONE))
    )


def _let_in(rig: Rig, intruder: Intruder) -> None:
    def answer(query: Any) -> None:
        sender = layout.parse_sender(str(query.key_expr))
        wish = packets.decode_join(bytes(query.payload))
        welcome = packets.Welcome(packets.REVISION, LIAR)
        if intruder.ring is not None:  # with the keys it has
            terms = (DRONE, wish.run, sender.who, sender.id)
            proof, agreed = Agreement(intruder.ring, *terms).answer(wish.proof)
            topics, trailer = Seal(agreed.down).seal(str(query.key_expr), b"", packets.key(1, bytes(32)))
            welcome = packets.Welcome(packets.REVISION, LIAR, proof, trailer + topics)
        query.reply(query.key_expr, packets.encode_own(welcome))

    intruder.held.append(intruder.session.declare_queryable(layout.join(DRONE, "*", "*"), answer))


def _lets_in(rig: Rig, _: Intruder) -> bool:
    def joins(session: FabricSession) -> bool:
        sender = layout.Sender("join", rig.who("wendy"), layout.new_id())
        request = JoinRequest(session.settings.ring, DRONE, LIAR, sender)
        wish = packets.encode_own(packets.Join(packets.REVISION, LIAR, proof=request.proof))
        key, target = layout.join(DRONE, sender.who, sender.id), zenoh.QueryTarget.ALL
        for reply in session.zenoh.get(
            key, payload=wish, target=target, consolidation=zenoh.ConsolidationMode.NONE, timeout=0.3
        ):
            welcome = packets.decode_welcome(bytes(reply.ok.payload)) if reply.ok is not None else None
            if welcome is not None and welcome.run == LIAR:
                with contextlib.suppress(LinkError):
                    request.accept(welcome)
                    return True
        return False

    return _as_wendy(rig, joins)


def _live_as_a_proxy(_: Rig, intruder: Intruder) -> None:
    intruder.held.append(intruder.session.liveliness().declare_token(layout.alive("zulu", "f" * 16)))


def _lives(rig: Rig, _: Intruder) -> bool:
    return _as_wendy(rig, lambda session: ("zulu", "f" * 16) in discovery.runs(session))


def _say_bye(rig: Rig, intruder: Intruder) -> None:
    jane = _of_jane(rig)
    key = layout.upward(layout.ASK, DRONE, jane["who"], jane["connection"])
    intruder.put(key, packets.bye("a lie"))


def _end_token(rig: Rig, intruder: Intruder) -> None:
    key = layout.app(DRONE, rig.who("jane"), rig.connection_of(rig.jane))
    intruder.session.liveliness().declare_token(key).undeclare()


def _cut_off(rig: Rig, _: Intruder) -> bool:
    return not rig.jane.closed_by.empty()


def _join_as_jane(rig: Rig, intruder: Intruder) -> None:
    if intruder.join(rig.who("jane")):
        intruder.got.append(("joined", b""))


def _joined(_: Rig, intruder: Intruder) -> bool:
    return any(key == "joined" for key, _ in intruder.got)


def _eavesdrop(rig: Rig, intruder: Intruder) -> None:
    intruder.listen(f"{layout.ROOT}/{DRONE}/command/**")
    rig.jane.command(Velocity(0.1))


def _heard(part: str) -> Callable[[Rig, Intruder], bool]:
    return lambda _, intruder: any(f"/{part}/" in key for key, _ in intruder.got)


def _eavesdrop_answers(rig: Rig, intruder: Intruder) -> None:
    intruder.listen(layout.to(DRONE, "*"))
    rig.jane.sync()


def _watch(rig: Rig, intruder: Intruder) -> None:
    intruder.see()
    intruder.listen(layout.topic(DRONE, FEEDBACK))
    rig.bench.driver.report()


def _look(rig: Rig, intruder: Intruder) -> None:
    intruder.see()
    intruder.listen(f"{layout.ROOT}/{DRONE}/video/**")
    rig.frames += 1
    header = FrameHeader("front", rig.frames, 1, 1, 2, 2, Encoding.MONO8, 4)
    rig.server.publish_frame(header, np.zeros(4, np.uint8))


def _read(rig: Rig, intruder: Intruder) -> None:
    intruder.join()
    intruder.request(layout.ASK, GetParameter(PARAMETER))


def _has_read(_: Rig, intruder: Intruder) -> bool:
    replies = [decode(packet) for key, packet in intruder.got if "/to/" in key and not packets.is_own(packet)]
    return any(isinstance(reply, Reply) and isinstance(reply.body, ParameterValue) for reply in replies)


def _find(_: Rig, intruder: Intruder) -> None:
    if intruder.ask(layout.info("*")):
        intruder.got.append(("found", b""))


def _found(_: Rig, intruder: Intruder) -> bool:
    return any(key == "found" for key, _ in intruder.got)


DEEDS = (
    Deed("find the drone", _find, _found),
    Deed("see its feedback", _watch, _heard("topic")),
    Deed("see its video", _look, _heard("video")),
    Deed("read its parameters", _read, _has_read),
    Deed("request the authority", _request_authority, _has_authority),
    Deed("stop its motors", _stop_motors, _stopped),
    Deed("fly it in another pilot's name", _fly_in_janes_name, _pushed),
    Deed("set a parameter in another pilot's name", _write_in_janes_name, _written),
    Deed("connect in another pilot's name", _join_as_jane, _joined),
    Deed("disconnect in another pilot's name", _say_bye, _cut_off),
    Deed("take over another pilot's liveliness token, and end it", _end_token, _cut_off),
    Deed("receive another pilot's commands", _eavesdrop, _heard("command")),
    Deed("receive the replies to another pilot", _eavesdrop_answers, _heard("to")),
    Deed("publish false feedback", _false_feedback, _fooled),
    Deed("publish a false event", _false_event, _alarmed),
    Deed("publish a false frame", _false_picture, _shown),
    Deed("answer another pilot in the proxy's place", _false_answer, _answered),
    Deed("answer discovery in the proxy's place", _stand_in, _stands_in),
    Deed("admit applications in the proxy's place", _let_in, _lets_in),
    Deed("appear as a proxy", _live_as_a_proxy, _lives),
)


#: The columns: whose key is used, in words.
COLUMNS = {
    "nobody": "without keys",
    "kim": "another pilot of it",
    "bob": "a pilot of others",
    "olga": "an observer",
    "oscar": "an observer of others",
    "bravo": "another drone's proxy",
    "hub": "a router",
    "eve": "revoked",
}
#: The attempts that work, by the deed's words; all others have no effect.
SEEN = {"nobody", "kim", "bob", "olga"}
WORKS = {
    "find the drone": {*SEEN, "oscar", "bravo", "hub"},
    "answer discovery in the proxy's place": {"nobody"},  # with keys, a proxy forwards nothing from others
    "see its feedback": SEEN,
    "see its video": SEEN,
    "read its parameters": SEEN,
    "request the authority": {"nobody", "kim"},
    "stop its motors": {"nobody", "kim"},
    "take over another pilot's liveliness token, and end it": set(),  # Zenoh: it lives while one of the two does
}


def works(deed: Deed, who: str) -> bool:
    return who in WORKS.get(deed.what, {"nobody"})


def comes_true(condition: Callable[[], bool], within_s: float) -> bool:
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True
