"""A session and an emulated Tello in one simulated time: no sockets, no threads, and datagrams are lost on request."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping

from skyloop.drivers.recording_sink import RecordingSink
from skyloop.messages import AnyAction, Feedback, FlightState
from skyloop.vehicles.tello.options import TelloOptions
from skyloop.vehicles.tello.protocol import TelloSession
from skyloop.vehicles.tello.wire import Sdk
from tests.support.recordings import recorded
from tests.vehicles.tello.emulator.rig import PILOT, Bench

STATE_TICKS = 5


class Rig:
    """``lost``: the share of datagrams lost in each direction. ``on``: the drone is switched on."""

    def __init__(
        self,
        options: TelloOptions | None = None,
        *,
        sdk: Sdk = Sdk.V3_0,
        lost: float = 0.0,
        pads: Mapping[int, tuple[float, float]] | None = None,
    ) -> None:
        self._sdk, self._pads = sdk, pads
        self.bench = Bench(sdk, pads)
        self.session = TelloSession(options or TelloOptions("drone", video=False), self.bench.clock.now_ns)
        self.sink = RecordingSink()
        self.on = True
        self.deaf = False  # it receives nothing, but sends
        self.mute = False  # it receives, but sends nothing
        self.sent: list[str] = []
        self._chance = random.Random(7)
        self._lost = lost
        self._told = 0
        self._ticks = 0

    @property
    def now_ns(self) -> int:
        return self.bench.clock.now_ns

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.02)):
            self.step()

    def until(self, condition: Callable[[], object], within_s: float) -> float:
        """Return the time until the condition holds [s]."""
        for steps in range(round(within_s / 0.02)):
            if condition():
                return steps * 0.02
            self.step()
        raise AssertionError(f"not within {within_s} s: {self.sink.links[-3:]}, {self.sink.newest}, {self.sent[-10:]}")

    def ready(self) -> None:
        self.until(lambda: self.session.ready, 8.0)

    def step(self) -> None:
        self.bench.tick()
        self._ticks += 1
        session, board = self.session, self.bench.logic
        if self.now_ns >= session.due_ns:
            for datagram in session.poll(self.now_ns):
                self.sent.append(datagram.decode())
                if self.on and not self.deaf and not self._is_lost():
                    board.receive(datagram, PILOT)
        answers, self._told = self.bench.answers[self._told :], len(self.bench.answers)
        for text, _ in answers:
            if self.on and not self.mute and not self._is_lost():
                session.on_reply(text.encode(), self.now_ns)
        state = board.state_string() if board.client is not None and self._ticks % STATE_TICKS == 0 else None
        if state is not None and self.on and not self.mute and not self._is_lost():
            session.on_state(state, self.now_ns)
        for publish in session.drain():
            publish(self.sink)

    def _is_lost(self) -> bool:
        return self._chance.random() < self._lost

    def do(self, action: AnyAction) -> AnyAction:
        return self.session.command(action, self.now_ns)

    def restart_drone(self) -> None:
        """Replace the drone with one that was just switched on."""
        now_ns = self.now_ns
        self.bench = Bench(self._sdk, self._pads)
        self.bench.clock.now_ns = now_ns
        self._told = 0
        self.on = True

    def take_sent(self) -> list[str]:
        sent, self.sent = self.sent, []
        return sent

    @property
    def feedback(self) -> Feedback:
        assert self.sink.newest is not None
        return self.sink.newest

    @property
    def state(self) -> FlightState:
        return self.feedback.state

    @property
    def reasons(self) -> list[object]:
        return [event.data.get("reason") for event in self.sink.events]


def strings() -> list[str]:
    return [
        line
        for line in recorded("tello/state_strings.txt").read_text().splitlines()
        if line and not line.startswith("#")
    ]
