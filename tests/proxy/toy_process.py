"""A proxy as a process with a toy vehicle: ``python -m tests.proxy.toy_process NAME [PARENT_FD]``.

It writes the calls its driver received to standard output. It takes off at once and lands within 50 ms.
"""

from __future__ import annotations

import sys
import threading

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.messages import AnyAction, FlightState, Land, LinkState, Takeoff
from skyloop.proxy import serve as serving
from tests.support.proxy_bench import FakeDriver


class Toy(FakeDriver):
    def _open(self, sink: Sink) -> None:
        self.sink = sink
        self.report(state=FlightState.LANDED)
        sink.link(LinkState.UP)

    def _apply(self, action: AnyAction) -> AnyAction:
        print(f"told {action.name}", flush=True)
        if isinstance(action, Takeoff):
            self.report(state=FlightState.HOVERING)
        elif isinstance(action, Land):
            self.report(state=FlightState.LANDING)
            threading.Timer(0.05, lambda: self.report(state=FlightState.LANDED)).start()
        return action

    def _close(self) -> None:
        print("closed", flush=True)


def main() -> None:
    setattr(serving, "make_driver", lambda uri: Toy(monotonic_ns))  # noqa: B010  (it is imported there)
    parent_fd = int(sys.argv[2]) if len(sys.argv) > 2 else None
    serving.serve("fake://", sys.argv[1], parent_fd=parent_fd)
    print("served", flush=True)


if __name__ == "__main__":
    main()
