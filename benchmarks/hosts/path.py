"""A bad link between two hosts, and its reports."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Final

from benchmarks.hosts.impairments import Impairments
from benchmarks.hosts.namespaces import Host, Lab
from benchmarks.hosts.relay import Direction, relay
from benchmarks.measuring.workers import STARTS_WITHIN_S, Workers

_ANSWERS_WITHIN_S: Final = 10.0
_QUEUE: Final = 1000  #: packets queued for the relay, as on an ordinary interface
_numbers = itertools.count()


class Path:
    """A point-to-point link whose packets pass through a process that impairs them. Ends with the lab.

    The fate of the n-th packet each way is the same in each run with the same seed and rates.

    Args:
        lab: The lab of both hosts.
        first: One host.
        second: The other.
        seed: Determines the fate of each packet.
        impairments: The effects on packets, both ways; by default none.
    """

    def __init__(self, lab: Lab, first: Host, second: Host, *, seed: int, impairments: Impairments | None = None):
        perfect = Impairments()
        self.impairments = (impairments or perfect, impairments or perfect)  #: to the second host, and back
        number = next(_numbers) % 250
        name = f"path{number}"
        self._worker = lab.enter(Workers()).start(
            relay, seed, ((first.pid, name), (second.pid, name)), self.impairments
        )
        self._worker.answer(STARTS_WITHIN_S)
        self.first, self.second = f"10.78.{number}.1", f"10.78.{number}.2"  #: the hosts' addresses on this path
        for host, here, there in ((first, self.first, self.second), (second, self.second, self.first)):
            # Otherwise the kernel's own packets, which search for routers, would change the fate of the others.
            host.run("sh", "-c", f"echo 1 > /proc/sys/net/ipv6/conf/{name}/disable_ipv6")
            host.ip(
                f"link set {name} txqueuelen {_QUEUE} up",
                f"address add {here} peer {there} dev {name}",
            )

    def set(self, impairments: Impairments, back: Impairments | None = None) -> None:
        """Set the effects on packets sent from now on.

        Args:
            impairments: To the second host.
            back: To the first host; by default the same.
        """
        self.impairments = (impairments, back or impairments)
        self._tell_relay(self.impairments)

    def cut(self) -> None:
        """Block everything from now on, without notifying the hosts."""
        there, back = self.impairments
        self._tell_relay((replace(there, loss=1.0), replace(back, loss=1.0)))

    def restore(self) -> None:
        """Restore the state before the cut."""
        self._tell_relay(self.impairments)

    def _tell_relay(self, impairments: tuple[Impairments, Impairments]) -> None:
        self._worker.pipe.send(impairments)
        self._worker.answer(_ANSWERS_WITHIN_S)

    def tell(self) -> tuple[Direction, Direction]:
        """Return the traffic from the first host to the second, and back, since the last call."""
        self._worker.pipe.send("tell")
        there, back = self._worker.answer(_ANSWERS_WITHIN_S)
        return there, back

    @property
    def pid(self) -> int:
        """The process in between, for measuring its processor time."""
        return self._worker.pid
