"""Settings of an emulated autopilot."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from skyloop.errors import UsageError
from skyloop.faults import Faults
from skyloop.sim.options import SimOptions

REPORTS_HZ: Final = 125.0  #: as often as a world that keeps time reports
APART: Final = 10


class Kind(StrEnum):
    """The autopilot that is emulated."""

    ARDUCOPTER = "arducopter"
    PX4 = "px4"


@dataclass(frozen=True, slots=True)
class Ports:
    """Ports of one emulated autopilot.

    Args:
        udp: The autopilot's own, from which it sends to ``remote`` until a message comes.
        remote: UDP, of the other end.
        tcp: Its server for one client; None: it has none.
    """

    udp: int
    remote: int
    tcp: int | None = None

    @classmethod
    def standard(cls, kind: Kind, drone: int = 0) -> Ports:
        """Return the ports of the real ones' simulations."""
        if kind is Kind.PX4:
            return cls(udp=14580 + drone, remote=14540 + drone)
        return cls(udp=5763 + APART * drone, remote=14550 + APART * drone, tcp=5760 + APART * drone)

    @classmethod
    def counted(cls, kind: Kind, base: int | None, drone: int) -> Ports:
        """Return ports from a number on, for each further drone 10 higher.

        The autopilot's own UDP port comes first, then the remote one, then that for TCP.

        Args:
            kind: Of the autopilot.
            base: The first port; None: the usual ones; 0: any that are free.
            drone: Its number.

        Raises:
            UsageError: They don't fit below 65536.
        """
        if base is None:
            return cls.standard(kind, drone)
        if base == 0:
            return cls.free(kind)
        first = base + APART * drone
        if not 0 < first <= 65533:
            raise UsageError(f"--port-base {base}: drone {drone} would need port {first + 2}; the last is 65535")
        return cls(first, first + 1, first + 2 if kind is Kind.ARDUCOPTER else None)

    @classmethod
    def free(cls, kind: Kind) -> Ports:
        """Return ports that are free now."""
        return cls.several(kind, 0, 1)[0]

    @classmethod
    def several(cls, kind: Kind, base: int | None, drones: int) -> list[Ports]:
        """Return the ports of several drones; none of them twice. See :meth:`counted`.

        Raises:
            UsageError: They don't fit below 65536.
        """
        if base != 0:
            return [cls.counted(kind, base, drone) for drone in range(drones)]
        with ExitStack() as held:  # of all of them: the system soon gives a port that was closed to the next who asks
            return [cls._held(kind, held) for _ in range(drones)]

    @classmethod
    def _held(cls, kind: Kind, held: ExitStack) -> Ports:
        udp, remote = (_free(held, socket.SOCK_DGRAM) for _ in range(2))
        return cls(udp, remote, _free(held, socket.SOCK_STREAM) if kind is Kind.ARDUCOPTER else None)


def _free(held: ExitStack, kind: socket.SocketKind) -> int:
    made = held.enter_context(socket.socket(socket.AF_INET, kind))
    made.bind(("127.0.0.1", 0))
    return int(made.getsockname()[1])


def with_multirotors(options: SimOptions | None = None, *, rate_hz: float = REPORTS_HZ) -> SimOptions:
    """Return options of a world for emulated autopilots: without cameras.

    Args:
        options: Of the world and its drones.
        rate_hz: How often an autopilot flies and sends [1/s], by default as often as possible. A fleet that is to cost
            little takes less: no message is sent more often than that.
    """
    return replace(options or SimOptions(), rate_hz=rate_hz, cameras=())


@dataclass(frozen=True, slots=True)
class Settings:
    """The arguments of :class:`skyloop.vehicles.mavlink.emulator.MavlinkFirmware`."""

    kind: Kind
    bind: str
    ports: Ports
    system: int
    faults: Faults
    delay_s: float
    boot_s: float
    gps: bool
    version: int
    key: bytes | None
    video: tuple[str, int] | None
