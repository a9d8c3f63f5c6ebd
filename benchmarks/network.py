"""Measure delays between two hosts over a lossy path, by datagrams and TCP or by TCP alone: ``benchmarks.network``."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path as File
from typing import Final

import msgspec

from benchmarks import over_network
from benchmarks.hosts.impairments import Impairments
from benchmarks.hosts.namespaces import Host, Lab
from benchmarks.hosts.path import Path
from benchmarks.measuring.contract import Arrivals
from benchmarks.measuring.pair import Pair
from benchmarks.measuring.schedule import CHANNELS, COMMAND, FRAME_PERIOD_S, VIDEO, Turn, sleep_until
from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.workers import STARTS_WITHIN_S, Pipe, Workers
from skyloop.bench import Machine, Spread, spread
from skyloop.files import MAX_RESULTS, read_json

LOSSES: Final = (0.0, 0.01, 0.1, 0.3)
DATAGRAMS: Final = "datagrams and TCP"
TCP: Final = "TCP only"
#: The vehicle's side of each connection, at the first end of the path. Without keys, an address means UDP and TCP.
WAYS: Final = {DATAGRAMS: "{address}:7447", TCP: "tcp/{address}:7447"}
#: Other effects than loss, as of a wireless network through a few walls.
PATH: Final = Impairments(delay_s=0.005, jitter_s=0.001, reorder=0.01, reorder_s=0.005)
TURN_S: Final = 10.0
_SEED: Final = 6
_WEIGHED_S: Final = 4.0
_STREAM_S: Final = 1.0
_STREAM_PORT: Final = 7448
_NAME: Final = "alpha"

Progress = Callable[[float, str], None]


class Channel(msgspec.Struct, frozen=True):
    """The samples of one channel sent and received."""

    sent: int
    arrived: int  #: number that arrived or, for commands, that were executed
    age: Summary | None  #: None if nothing arrived

    @property
    def share(self) -> float:
        return self.arrived / self.sent


class CaseResult(msgspec.Struct, frozen=True):
    """One kind of connection with one rate of loss. ``relay``: delays added by the path's own process."""

    way: str
    loss: float
    channels: dict[str, Channel]
    frames_per_s: float
    relay: Spread


class Wire(msgspec.Struct, frozen=True):
    """Bytes on the path for each sample, IP headers and acknowledgements included."""

    command: float
    feedback: float
    frame: float
    frame_back: float  #: the viewer's acknowledgement to the proxy


class Network(msgspec.Struct, frozen=True, tag_field="what", tag="network"):
    """A whole run, as in ``network.json``. ``seconds``: how long each case was measured."""

    machine: Machine
    seconds: float
    path: str
    cases: list[CaseResult]
    wire: Wire | None = None
    megabytes_per_s: float = 0.0  #: capacity of the path's own process with one TCP connection

    def case(self, way: str, loss: float) -> CaseResult | None:
        """Return a case's result; None if it was not measured."""
        return next((case for case in self.cases if (case.way, case.loss) == (way, loss)), None)


def measure(
    seconds: float,
    losses: Sequence[float] = LOSSES,
    ways: Sequence[str] = tuple(WAYS),
    progress: Progress = lambda _share, _what: None,
) -> Network:
    """Measure each connection with each rate of loss, in turns.

    Args:
        seconds: Duration of each case [s].
        losses: Fractions of packets lost.
        ways: The ways to connect, by name.
        progress: Called with the fraction done, 0 to 1, and the next step.

    Raises:
        UnsupportedError: No hosts can be created here.
    """
    machine = Machine.here()
    rounds = max(1, round(seconds / TURN_S))
    tallies = [_Tally(way, loss) for way in ways for loss in losses]
    with Lab() as lab, Workers() as workers:
        hosts = lab.host("vehicle"), lab.host("pilot")
        megabytes_per_s = stream(lab, workers, *hosts)
        stages = {way: _Stage(lab, workers, hosts, way) for way in ways}
        wire = stages[DATAGRAMS].weigh() if DATAGRAMS in stages else None
        for number in range(rounds):
            for index, tally in enumerate(tallies):
                progress((number + index / len(tallies)) / rounds, f"{tally.way}, {tally.loss:.0%} lost")
                turn = Turn(number, seconds / rounds)
                tally.add(turn, *stages[tally.way].play(turn, tally.loss))
    results = [tally.result(seconds) for tally in tallies]
    return Network(machine, seconds, describe(PATH), results, wire, megabytes_per_s)


class _Stage:
    """A path, and both ends of one kind of connection."""

    def __init__(self, lab: Lab, workers: Workers, hosts: tuple[Host, Host], way: str) -> None:
        self._path = Path(lab, *hosts, seed=_SEED, impairments=PATH)
        there, here = hosts
        place = WAYS[way].format(address=self._path.first)
        self._pair = Pair(
            workers,
            "benchmarks.over_network",
            over_network.address(_NAME, place),
            prefixes=(there.prefix, here.prefix),
        )

    def play(self, turn: Turn, loss: float) -> tuple[Arrivals, list[int]]:
        """Run a turn, connecting before any loss; return the arrivals, and the relay's own delays [ns]."""
        self._path.set(PATH)
        self._pair.open(turn)
        self._path.tell()
        self._path.set(replace(PATH, loss=loss))
        arrivals = self._pair.arrivals(turn, self._pair.begin())
        there, back = self._path.tell()
        return arrivals, there.late_ns + back.late_ns

    def weigh(self) -> Wire:
        """Return the bytes for each sample, from a turn with video and one with almost none."""
        sizes: list[tuple[int, int]] = []
        turns = [Turn(0, _WEIGHED_S, frame_period_s=period_s) for period_s in (10 * _WEIGHED_S, FRAME_PERIOD_S)]
        for turn in turns:
            self._path.set(Impairments())
            self._pair.open(turn)
            begin_ns = self._pair.begin()
            sleep_until(begin_ns)
            self._path.tell()
            sleep_until(begin_ns + round(_WEIGHED_S * 1e9))
            there, back = self._path.tell()
            self._pair.arrivals(turn, begin_ns)
            sizes.append((there.size, back.size))
        without, with_frames = sizes
        packets, frames = turns[0].count(COMMAND), turns[1].count(VIDEO) - 1
        return Wire(
            command=without[1] / packets,
            feedback=without[0] / packets,
            frame=(with_frames[0] - without[0]) / frames,
            frame_back=(with_frames[1] - without[1]) / frames,
        )


def stream(lab: Lab, workers: Workers, first: Host, second: Host) -> float:
    """Return the speed of a TCP connection over a perfect path [MB/s]: the limit of this harness."""
    path = Path(lab, first, second, seed=_SEED)
    there = workers.start(drain, path.first, prefix=first.prefix)
    there.answer(STARTS_WITHIN_S)
    here = workers.start(pour, path.first, prefix=second.prefix)
    here.answer(STARTS_WITHIN_S)
    size, took_s = there.answer(STARTS_WITHIN_S)
    return float(size / took_s / 1e6)


def drain(pipe: Pipe, address: str) -> None:
    """Receive from one connection; send back the number of bytes and the time [s]."""
    with socket.create_server((address, _STREAM_PORT)) as listener:
        pipe.send("ready")
        connection, _ = listener.accept()
        begin_s, size = time.monotonic(), 0
        with connection:
            while data := connection.recv(1 << 20):
                size += len(data)
    pipe.send((size, time.monotonic() - begin_s))


def pour(pipe: Pipe, address: str) -> None:
    """Send as much as possible."""
    pipe.send("ready")
    end_s, data = time.monotonic() + _STREAM_S, bytes(1 << 18)
    with socket.create_connection((address, _STREAM_PORT)) as connection:
        while time.monotonic() < end_s:
            connection.sendall(data)


class _Tally:
    """The measurements of one case so far."""

    def __init__(self, way: str, loss: float) -> None:
        self.way = way
        self.loss = loss
        self._delays_ns: dict[str, list[int]] = {channel: [] for channel in CHANNELS}
        self._sent = dict.fromkeys(CHANNELS, 0)
        self._period_s: dict[str, float] = {}
        self._late_ns: list[int] = []

    def add(self, turn: Turn, arrivals: Arrivals, late_ns: Sequence[int]) -> None:
        self._late_ns += late_ns
        for channel in CHANNELS:
            self._period_s[channel] = turn.period_s(channel)
            self._sent[channel] += turn.count(channel)
            self._delays_ns[channel] += [received - sent for sent, received in arrivals[channel]]

    def result(self, seconds: float) -> CaseResult:
        channels = {channel: self._channel(channel) for channel in CHANNELS}
        return CaseResult(self.way, self.loss, channels, channels[VIDEO].arrived / seconds, spread(self._late_ns))

    def _channel(self, channel: str) -> Channel:
        delays_ns, sent = self._delays_ns[channel], self._sent[channel]
        age = summarize(delays_ns, sent=sent, period_s=self._period_s[channel]) if delays_ns else None
        return Channel(sent, len(delays_ns), age)


def describe(path: Impairments) -> str:
    """Describe the path."""
    return (
        f"{path.delay_s * 1e3:g} ms each way and up to {path.jitter_s * 1e3:g} ms more; "
        f"{path.reorder:.0%} held back for {path.reorder_s * 1e3:g} ms"
    )


def load(path: File) -> Network:
    """Read ``network.json``.

    Raises:
        FileFormatError: The file has another format.
    """
    return read_json(path, Network, "the results of benchmarks.network", MAX_RESULTS)


if __name__ == "__main__":
    from benchmarks.command import main

    main("network")
