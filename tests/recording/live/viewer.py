"""A small viewer of a Foxglove server, for tests, from the protocol's specification.

https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
"""

from __future__ import annotations

import itertools
import json
import struct
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import Any, Self

from websockets.sync.client import connect
from websockets.typing import Subprotocol

WAIT_S = 10.0
_MESSAGE = 1


class Viewer:
    """Connected from the start; reads the server's messages only on request."""

    def __init__(self, url: str) -> None:
        self.topics: dict[str, dict[str, Any]] = {}
        self.messages: list[tuple[str, int, bytes]] = []  #: topic, log time [ns], bytes
        self.status: list[str] = []
        self.parameters: dict[str, Any] = {}
        self.answers: dict[str, list[dict[str, Any]]] = {}
        self._subscribed: dict[int, str] = {}
        self._numbers = itertools.count(1)  # number of the subscription, to recognise late messages of an old one
        self._stack = ExitStack()
        dialled = connect(
            url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_queue=1, max_size=None, close_timeout=0.1
        )
        self._socket = self._stack.enter_context(dialled)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._stack.close()

    def until(self, done: Callable[[Self], object], what: str = "") -> None:
        """Read until a condition holds."""
        end = time.monotonic() + WAIT_S
        while not done(self):
            left = end - time.monotonic()
            assert left > 0, f"{what or 'it'} did not come in {WAIT_S} s: {sorted(self.topics)} {self.status}"
            try:
                self._receive(self._socket.recv(timeout=min(left, 0.1)))
            except TimeoutError:
                continue

    def subscribe(self, *topics: str) -> None:
        self.until(lambda viewer: set(topics) <= viewer.topics.keys(), f"the topics {topics}")
        for topic in topics:
            number = next(self._numbers)
            self._subscribed[number] = topic
            self._send(op="subscribe", subscriptions=[{"id": number, "channelId": self.topics[topic]["id"]}])

    def unsubscribe(self, topic: str) -> None:
        number = next(number for number, name in self._subscribed.items() if name == topic)
        del self._subscribed[number]
        self._send(op="unsubscribe", subscriptionIds=[number])

    def get_parameters(self, names: Iterable[str] = ()) -> list[dict[str, Any]]:
        self._send(op="getParameters", parameterNames=list(names), id="get")
        return self._answer("get")

    def follow_parameters(self, names: Sequence[str]) -> None:
        self._send(op="subscribeParameterUpdates", parameterNames=list(names))
        self.get_parameters(names)  # answered after the line above was heard: what changes from now on is sent

    def set_parameter(self, name: str, value: object) -> list[dict[str, Any]]:
        self._send(op="setParameters", parameters=[{"name": name, "value": value}], id="set")
        return self._answer("set")

    def of(self, topic: str) -> list[bytes]:
        return [data for name, _, data in self.messages if name == topic]

    def _answer(self, number: str) -> list[dict[str, Any]]:
        self.until(lambda viewer: number in viewer.answers, f"the answer to {number}")
        return self.answers.pop(number)

    def _send(self, **message: object) -> None:
        self._socket.send(json.dumps(message))

    def _receive(self, data: str | bytes) -> None:
        if isinstance(data, bytes):
            if data[0] == _MESSAGE:
                number, log_ns = struct.unpack_from("<IQ", data, 1)
                if number in self._subscribed:
                    self.messages.append((self._subscribed[number], log_ns, data[13:]))
            return
        message = json.loads(data)
        match message["op"]:
            case "advertise":
                self.topics |= {channel["topic"]: channel for channel in message["channels"]}
            case "status":
                self.status.append(message["message"])
            case "parameterValues":
                self.parameters |= {each["name"]: each.get("value") for each in message["parameters"]}
                if "id" in message:
                    self.answers[message["id"]] = message["parameters"]
