"""Requests a lot from a proxy over the network, and reads nothing: ``stalled.py ENDPOINT KEYS DRONE COUNT``.

It says ``joined N`` once it has that many connections, and ``stalled`` once it has sent its requests.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

import zenoh
from zenoh.handlers import Callback

from skyloop.messages import AnyRequest, Hello, ListParameters, Ping, Request, Role, encode
from skyloop.network import layout, packets
from skyloop.network.admission import Admission, JoinRequest
from skyloop.network.keys import KeyRing, load
from tests.promises.security.rig import third_party

LISTS, PINGS = 16, 200


def main(endpoint: str, keys: Path, drone: str, count: int) -> None:
    session = third_party(endpoint, keys)
    reads = threading.Event()
    reads.set()

    def heard(_: Any) -> None:  # on Zenoh's receiving thread: while it waits here, nothing is read
        reads.wait()

    replies = session.get(layout.info(drone), timeout=3.0)
    (about,) = [packets.decode_info(bytes(reply.ok.payload)) for reply in replies if reply.ok is not None]
    ring = KeyRing(load(keys))
    held: list[Any] = []
    asks: list[tuple[str, Admission]] = []
    for _ in range(count):
        connection = layout.new_id()
        held.append(session.declare_subscriber(layout.to(drone, connection), Callback(heard, indirect=False)))
        held.append(session.liveliness().declare_token(layout.app(drone, keys.name, connection)))
        request = JoinRequest(ring, drone, about.run, layout.Sender("join", keys.name, connection))
        wish = packets.encode_own(packets.Join(packets.REVISION, about.run, proof=request.proof))
        answers = session.get(layout.join(drone, keys.name, connection), payload=wish, timeout=3.0)
        for answer in answers:
            if answer.ok is not None:
                admission = request.accept(packets.decode_welcome(bytes(answer.ok.payload)))
                asks.append((layout.upward(layout.ASK, drone, keys.name, connection), admission))
    print(f"joined {len(asks)}", flush=True)
    reads.clear()
    bodies: list[AnyRequest] = [Hello("stalled", Role.OBSERVER), *[ListParameters()] * LISTS, *[Ping(1)] * PINGS]
    for number, body in enumerate(bodies, 1):
        for ask, admission in asks:
            payload, attachment = admission.sealer.seal(ask, packets.number(number), encode(Request(number, body)))
            session.put(
                ask,
                payload,
                attachment=attachment,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
    print("stalled", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
