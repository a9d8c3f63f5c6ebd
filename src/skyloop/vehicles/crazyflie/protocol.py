"""The protocol with one vehicle, from the first packet on. No I/O, no clock."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum, auto
from functools import partial
from typing import Final

from skyloop.clock import LiveClock, nanoseconds
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.vehicle_session import (
    LinkTimeouts,
    PacketOrder,
    RestartWatch,
    VehicleEvent,
    VehicleSession,
    message,
)
from skyloop.errors import DecodeError, DriverError
from skyloop.messages import AnyAction, EmergencyStop, LinkState, Severity, Value
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.crazyflie.cache import ContentsCache
from skyloop.vehicles.crazyflie.options import CrazyflieOptions, LinkKind
from skyloop.vehicles.crazyflie.setpoints import CrazyflieSetpoints
from skyloop.vehicles.crazyflie.telemetry import (
    DECKS,
    ESTIMATOR,
    RANGE_FINDERS,
    SLOW_PERIOD_MS,
    CrazyflieTelemetry,
    choose_variables,
)
from skyloop.vehicles.crazyflie.wire import contents
from skyloop.vehicles.crazyflie.wire.commander import (
    EmergencyStopMessage,
    ExternalPoseMessage,
    HighLevelStop,
    Message,
    Recover,
    VersionQuery,
    ask_version,
    decode_version_answer,
    is_finite,
)
from skyloop.vehicles.crazyflie.wire.contents import (
    ContentsInfo,
    Entry,
    LogCommand,
    LogRequest,
    MiscCommand,
    MiscMessage,
)
from skyloop.vehicles.crazyflie.wire.crtp import (
    DATA,
    HELLO,
    MISCELLANEOUS,
    NEWEST_PROTOCOL,
    NULL_PACKET,
    OLDEST_PROTOCOL,
    POWER_OFF,
    POWER_ON,
    CrtpPacket,
    CrtpPort,
    with_checksum,
    without_checksum,
)

PATIENCE_NS: Final = nanoseconds(0.25)  #: time allowed for an answer
TRIES: Final = 20  #: number of times a request is sent
FEW_TRIES: Final = 4  #: the same for a request with a waiting caller, or that old firmware may not answer
WINDOW: Final = 4  #: number of requests under way at once: firmware keeps few packets
TICK_NS: Final = nanoseconds(0.02)
HELLO_NS: Final = nanoseconds(0.25)  #: time between two attempts to connect
ALIVE_NS: Final = nanoseconds(0.5)  #: time between packets that keep a connection over UDP open
DEGRADED_NS: Final = nanoseconds(0.5)
LOST_NS: Final = nanoseconds(1.5)
FIRST_DATA_NS: Final = nanoseconds(2.0)
CLOCK_WINDOW_S: Final = 1.0  #: window of the estimate of the vehicle's clock, which is slow in a starved simulation
STAMPS: Final = 1 << 24  #: log time stamps [ms] begin again there
MAX_CONSOLE: Final = 400  #: longest line kept from the console [characters]
RESTART_NS: Final = nanoseconds(0.3)  #: how long it stays off

#: Parameter of older firmware that switches the high-level commander on.
HIGH_LEVEL: Final = "commander.enHighLevel"

#: Called with the answer, or None if there was none.
Done = Callable[[CrtpPacket | None], None]


@dataclass(slots=True)
class CrtpRequest:
    """A packet to which an answer is expected that begins with the same bytes."""

    packet: CrtpPacket
    prefix: bytes  #: start of the answer's data
    done: Done
    tries: int = TRIES
    sent_ns: int | None = None

    def fits(self, answer: CrtpPacket) -> bool:
        same = (answer.port, answer.channel) == (self.packet.port, self.packet.channel)
        return same and answer.data[: len(self.prefix)] == self.prefix


class Stage(Enum):
    """Progress of a connection."""

    CALLING = auto()  #: no packet has arrived
    ASKING = auto()  #: versions and tables are being read
    LOGGING = auto()  #: log blocks are requested; their data follows


@dataclass(slots=True, eq=False)
class Table:
    """A table of contents, while and after it is read."""

    port: CrtpPort
    info: ContentsInfo | None = None
    entries: dict[int, Entry] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        return self.info is not None and len(self.entries) == self.info.count


class CrazyflieSession(VehicleSession):
    """The protocol between an open driver and its vehicle. Not thread-safe.

    ``extra`` returns further telemetry for ``Feedback.native``.
    """

    TIMEOUTS = LinkTimeouts(DEGRADED_NS, LOST_NS, FIRST_DATA_NS)

    def __init__(
        self,
        options: CrazyflieOptions,
        now_ns: int,
        *,
        cache: ContentsCache | None = None,
        extra: Callable[[], Mapping[str, Value]] = dict,
    ) -> None:
        super().__init__(now_ns)
        self.options = options
        self.telemetry = CrazyflieTelemetry()
        self.setpoints = CrazyflieSetpoints(self.telemetry, options.velocity, dict(options.limits))
        self.setpoints.restartable = options.kind is LinkKind.RADIO
        self.counts = Counter(dict.fromkeys(("received", "damaged", "late", "unanswered"), 0))
        self.protocol = NEWEST_PROTOCOL
        self._knows_protocol = False
        self.firmware = ""
        self.device = ""
        self.values: dict[int, float] = {}  #: the parameters' values that are known, by number
        self.parameters = Table(CrtpPort.PARAMETERS)
        self._log = Table(CrtpPort.LOG)
        self._cache = cache or ContentsCache()
        self._extra = extra
        self._stage = Stage.CALLING
        self._queue: deque[CrtpRequest] = deque()
        self._under_way: list[CrtpRequest] = []
        self._abandoned = False  # whether requests are ended rather than unanswered
        self._enabled = False  # whether the high-level commander was switched on
        self._first: list[int] = []  # numbers of the parameters to read at once
        self._rest: list[int] = []  # numbers of the others
        self._blocks: dict[int, list[Entry]] = {}
        self._main = 0  # the block whose data completes a state
        self._urgent: deque[bytes] = deque()  # packets to be sent at the next poll, without an answer
        self._watch = RestartWatch(wrap=STAMPS)
        self._live = LiveClock(CLOCK_WINDOW_S)
        self._wraps, self._stamp = 0, 0
        self._called_ns = now_ns - HELLO_NS
        self._alive_ns = now_ns
        self._began_ns = now_ns  # when the current stage began
        self._console = ""
        self._power_ns: int | None = None  # when to switch the restarted vehicle on
        self._set_link_state(LinkState.CONNECTING, f"waiting for the Crazyflie at {options}")

    @property
    def protocol_text(self) -> str:
        """The protocol's version as text; empty until it is known."""
        return str(self.protocol) if self._knows_protocol else ""

    # From the driver -----------------------------------------------------------------------------------------------

    def command(self, action: AnyAction, now_ns: int, *, new: bool = True) -> AnyAction:
        """Accept an action; see :meth:`CrazyflieSetpoints.apply`."""
        before = self.setpoints.intent
        applied = self.setpoints.apply(action, now_ns, new=new)
        self._keep(action, now_ns)
        if self.setpoints.intent != before or isinstance(action, EmergencyStop):
            self.due_ns = now_ns
        return applied

    def ask(self, packet: CrtpPacket, prefix: bytes, done: Done, tries: int = TRIES) -> None:
        """Send a packet until it is answered."""
        self._queue.append(CrtpRequest(packet, prefix, done, tries))
        self.due_ns = 0

    def _ask_first(self, packet: CrtpPacket, prefix: bytes, done: Done) -> None:
        """Send a packet before all other requests, for as long as the caller waits for its answer."""
        self._queue.appendleft(CrtpRequest(packet, prefix, done, FEW_TRIES))
        self.due_ns = 0

    def send_pose(self, pose: ExternalPose, now_ns: int) -> None:
        """Send the vehicle its pose; see :meth:`skyloop.drivers.base.Driver.external_pose`."""
        pose.bounded(now_ns)
        if self._received_ns is None:
            raise DriverError("no data from the vehicle: the pose is not sent")
        self._urgent.append(self._framed(ExternalPoseMessage(*pose.position_m, *pose.quaternion).encode(self.protocol)))
        self.due_ns = 0

    def write(self, number: int, value: float, done: Done) -> None:
        """Write a parameter; raises ``ValueError`` if the value doesn't fit its type."""
        entry = self.parameters.entries[number]
        packet = contents.write_parameter(number, entry.type.encode(value))
        self._ask_first(packet, packet.data[:2], partial(self._on_written, done))

    def store(self, number: int, done: Done, *, clear: bool) -> None:
        """Keep a parameter's value in the vehicle's memory, or forget the kept one."""
        packet = MiscMessage(MiscCommand.CLEAR if clear else MiscCommand.STORE, number).encode()
        self._ask_first(packet, packet.data[:3], done)

    def _new_events(self) -> list[VehicleEvent]:
        return self.setpoints.pop_events()

    def _forget_landing(self) -> bool:
        return self.setpoints.forget_landing()

    def diagnose(self) -> list[Diagnostic]:
        return self.telemetry.diagnose()

    def close(self) -> None:
        self._abandon()

    def _abandon(self) -> None:
        waiting = [*self._under_way, *self._queue]
        self._under_way.clear()
        self._queue.clear()
        self._abandoned = True
        for request in waiting:
            request.done(None)
        self._abandoned = False

    # From the link ---------------------------------------------------------------------------------------------------

    def on_datagram(self, datagram: bytes, now_ns: int) -> None:
        """Handle what was received. Never raises, whatever the content."""
        try:
            packet = CrtpPacket.decode(without_checksum(datagram) if self.options.checksum else datagram)
            self._on_packet(packet, now_ns)
        except DecodeError:
            self.counts["damaged"] += 1

    def _on_packet(self, packet: CrtpPacket, now_ns: int) -> None:
        self.counts["received"] += 1
        if self._stage is Stage.CALLING:
            self._begin(now_ns)
        elif self._stage is Stage.ASKING:
            self._received_ns = now_ns
        if packet.port == CrtpPort.LOG and packet.channel == DATA:
            self._on_log_data(packet, now_ns)
            return
        if packet.port == CrtpPort.CONSOLE:
            self._on_console(packet.data)
            return
        if packet.port == CrtpPort.HIGH_LEVEL and len(packet.data) >= 1:
            self.due_ns = now_ns
            self.setpoints.on_answer(packet.data[0], packet.data[3] if len(packet.data) > 3 else 0, now_ns)
            return
        for request in self._under_way:
            if request.fits(packet):
                self._under_way.remove(request)
                self.due_ns = 0
                request.done(packet)
                return
        if packet.port == CrtpPort.PARAMETERS and packet.channel == MISCELLANEOUS and packet.data[:1] == b"\x01":
            updated = MiscMessage.decode(packet)
            self._on_value(updated.number, updated.data)

    def _on_console(self, data: bytes) -> None:
        self._console = (self._console + data.decode("utf-8", "replace"))[-MAX_CONSOLE:]
        *lines, self._console = self._console.replace("\r", "\n").split("\n")
        for line in lines:
            if text := "".join(c for c in line if c.isprintable()).strip("\0 "):
                self._publish_event(message(text, "console"))

    def _on_log_data(self, packet: CrtpPacket, now_ns: int) -> None:
        block, stamp, data = contents.decode_log_data(packet)
        entries = self._blocks.get(block)
        if entries is None or self._stage is not Stage.LOGGING:
            return
        values = contents.decode_values(entries, data)
        if block != self._main:
            self.telemetry.update(values, now_ns)
            return
        order = self._watch.update(stamp, now_ns)
        if order is PacketOrder.LATE:
            self.counts["late"] += 1
            return
        if order is PacketOrder.RESTARTED:
            self._lose("the vehicle has restarted", now_ns)
            return
        if stamp < self._stamp and self._stamp - stamp > STAMPS // 2:
            self._wraps += 1
        self._stamp = stamp
        captured_ns = self._live.captured_ns((self._wraps * STAMPS + stamp) / 1000, now_ns)
        self._received_ns = now_ns
        self.telemetry.update(values, now_ns)
        self.setpoints.on_state(now_ns)
        self._unreachable = ""
        self._set_link_state(LinkState.UP)
        for event in self.telemetry.changes():
            self._publish_event(event)
        native: dict[str, Value] = {f"link.{name}": count for name, count in self.counts.items()}
        native.update(self._extra())
        feedback = self.telemetry.feedback(self.setpoints.flight_state(now_ns), captured_ns, native)
        self._pending.append(lambda sink: sink.feedback(feedback))

    # The connection: versions, tables, log blocks, parameters ---------------------------------------------------------

    def _begin(self, now_ns: int) -> None:
        self._stage, self._received_ns, self._began_ns = Stage.ASKING, now_ns, now_ns
        self._unreachable = ""
        self._log, self.parameters = Table(CrtpPort.LOG), Table(CrtpPort.PARAMETERS)
        self.values.clear()
        self._enabled = False
        self.due_ns = 0
        for query in VersionQuery:
            # Old firmware names no device, and ESP-Drone's no version.
            may_miss = query is not VersionQuery.PROTOCOL or self.options.checksum
            tries = 2 * FEW_TRIES if may_miss else TRIES
            self.ask(ask_version(query), bytes((query,)), partial(self._on_version, query), tries)

    def _on_version(self, query: VersionQuery, answer: CrtpPacket | None) -> None:
        if answer is not None:
            _, number, text = decode_version_answer(answer)
        if self._abandoned:
            return
        if query is VersionQuery.PROTOCOL and answer is None and not self.options.checksum:
            self._restart("it does not answer")
        elif query is VersionQuery.PROTOCOL:
            self.protocol, self._knows_protocol = number if answer is not None else 0, True
            if not OLDEST_PROTOCOL <= self.protocol <= NEWEST_PROTOCOL:
                text = (
                    f"the vehicle speaks version {self.protocol} of its protocol; "
                    f"Skyloop knows {OLDEST_PROTOCOL} to {NEWEST_PROTOCOL}"
                )
                self._publish_event(message(text, "protocol", Severity.WARNING, version=self.protocol))
            for table in (self.parameters, self._log):
                self.ask(contents.ask_info(table.port), b"\x03", partial(self._on_info, table))
        elif query is VersionQuery.FIRMWARE and answer is not None:
            self.firmware = text
        elif query is VersionQuery.DEVICE:
            self.device = text if answer is not None else ""

    def _on_info(self, table: Table, answer: CrtpPacket | None) -> None:
        info = None if answer is None else contents.decode_contents(answer)
        if not isinstance(info, ContentsInfo):
            self._restart("it does not answer")
            return
        table.info = info
        known = self._cache.load(table.port, info)
        if known is not None:
            table.entries = {entry.number: entry for entry in known}
            self._on_complete(table)
            return
        for number in range(info.count):
            packet = contents.ask_item(table.port, number)
            self.ask(packet, packet.data, partial(self._on_item, table))

    def _on_item(self, table: Table, answer: CrtpPacket | None) -> None:
        if self._abandoned:
            return
        entry = None if answer is None else contents.decode_contents(answer)
        if not isinstance(entry, Entry):
            self._restart("its tables of contents can't be read")
            return
        table.entries[entry.number] = entry
        if table.complete and table.info is not None:
            self._cache.save(table.port, table.info, [table.entries[number] for number in sorted(table.entries)])
            self._on_complete(table)

    def _on_complete(self, table: Table) -> None:
        if table is self.parameters:
            wanted = {*DECKS, *RANGE_FINDERS, ESTIMATOR, HIGH_LEVEL}
            ordered = sorted(table.entries.values(), key=lambda entry: entry.full_name not in wanted)
            self._first = [entry.number for entry in ordered if entry.full_name in wanted]
            self._rest = [entry.number for entry in ordered if entry.full_name not in wanted]
            self._read(self._first)
        elif table is self._log:
            reset = LogRequest(LogCommand.RESET).encode()
            self.ask(reset, reset.data, self._on_reset)

    def _read(self, numbers: list[int]) -> None:
        for number in numbers:
            packet = contents.read_parameter(number)
            self.ask(packet, packet.data, self._on_read)

    def _on_read(self, answer: CrtpPacket | None) -> None:
        if answer is None:
            return
        number, error, data = contents.decode_read_answer(answer)
        if not error:
            self._on_value(number, data)

    def _on_written(self, done: Done, answer: CrtpPacket | None) -> None:
        if answer is not None:
            with suppress(DecodeError):
                self._on_value(*contents.decode_parameter(answer))
        done(answer)

    def _on_value(self, number: int, data: bytes) -> None:
        entry = self.parameters.entries.get(number)
        if entry is None:
            return
        value = self.values[number] = entry.type.decode(data[: entry.type.size])
        if entry.full_name in (*DECKS, *RANGE_FINDERS, ESTIMATOR):
            self.telemetry.parameters[entry.full_name] = value
        elif entry.full_name == HIGH_LEVEL and not value and not self._enabled:
            self._enabled = True
            self.write(number, 1, _ignore)

    def _on_reset(self, answer: CrtpPacket | None) -> None:
        main, slow = choose_variables(list(self._log.entries.values()))
        if answer is None or not main:
            self._restart("it reports no state estimate" if answer is not None else "it does not answer")
            return
        groups = contents.blocks_of(main)
        self._main = len(groups) - 1
        often = [(entries, round(1000 / self.options.rate_hz)) for entries in groups]
        seldom = [(entries, SLOW_PERIOD_MS) for entries in contents.blocks_of(slow)]
        self._blocks = {}
        for block, (entries, period_ms) in enumerate([*often, *seldom]):
            self._blocks[block] = entries
            for request in [
                *contents.create_block(block, entries),
                LogRequest(LogCommand.START, block, period_ms=period_ms),
            ]:
                packet = request.encode()
                self.ask(packet, packet.data[:2], self._on_block)
        self._stage = Stage.LOGGING
        self._read(self._rest)

    def _on_block(self, answer: CrtpPacket | None) -> None:
        if answer is None:
            return
        command, block, error = contents.decode_log_answer(answer)
        if error and (command, error) != (LogCommand.CREATE, contents.CrtpError.EXISTS):
            text = f"the vehicle refuses log block {block} (error {error}): part of its telemetry is missing"
            self._publish_event(message(text, "log_refused", Severity.WARNING, block=block, error=error))

    def _restart(self, reason: str) -> None:
        """Begin the connection again, after a pause."""
        if self._abandoned:
            return
        self._abandon()
        self._stage = Stage.CALLING
        self._unreachable = reason
        self._received_ns = None

    # Time -----------------------------------------------------------------------------------------------------------

    def poll(self, now_ns: int) -> list[bytes]:
        """Return the packets to send now."""
        self._check_silence(now_ns)
        self.due_ns = now_ns + TICK_NS
        packets = list(self._urgent)
        self._urgent.clear()
        for each in self._messages(now_ns):
            # Before the version is known, a stop is sent in all layouts.
            unknown = isinstance(each, EmergencyStopMessage) and not self._knows_protocol
            versions = [self.protocol] if not unknown else [OLDEST_PROTOCOL, NEWEST_PROTOCOL]
            packets += [self._framed(each.encode(version)) for version in versions]
        packets += self._power(now_ns)
        if self._stage is Stage.CALLING:
            if now_ns - self._called_ns >= HELLO_NS:
                self._called_ns = now_ns
                packets += self._calls()
            return packets
        packets += self._requests(now_ns)
        if packets:
            self._alive_ns = now_ns
        elif now_ns - self._alive_ns >= ALIVE_NS:
            self._alive_ns = now_ns
            packets.append(self._framed(NULL_PACKET))
        return packets

    def _messages(self, now_ns: int) -> list[Message]:
        sent = [each for each in self.setpoints.messages(now_ns) if is_finite(each)]
        if self.setpoints.reset_wanted:
            self.setpoints.reset_wanted = False
            if self.telemetry.is_locked:
                self._urgent.append(self._framed(POWER_OFF))
                self._power_ns = now_ns + RESTART_NS
            else:
                sent += [HighLevelStop(), Recover()]  # end an earlier flight first
        return sent

    def _power(self, now_ns: int) -> list[bytes]:
        if self._power_ns is None or now_ns < self._power_ns:
            return []
        self._power_ns = None
        return [self._framed(POWER_ON)]

    def _calls(self) -> list[bytes]:
        ask = self._framed(ask_version(VersionQuery.PROTOCOL))
        return [HELLO, ask] if self.options.kind is LinkKind.UDP else [ask]

    def _requests(self, now_ns: int) -> list[bytes]:
        sent = []
        for request in list(self._under_way):
            if request.sent_ns is not None and now_ns - request.sent_ns < PATIENCE_NS:
                continue
            request.tries -= 1
            if request.tries <= 0:
                self._under_way.remove(request)
                self.counts["unanswered"] += 1
                request.done(None)
                continue
            request.sent_ns = now_ns
            sent.append(self._framed(request.packet))
        while self._queue and len(self._under_way) < WINDOW:
            request = self._queue.popleft()
            request.sent_ns = now_ns
            self._under_way.append(request)
            sent.append(self._framed(request.packet))
        return sent

    def _framed(self, packet: CrtpPacket) -> bytes:
        encoded = packet.encode()
        return with_checksum(encoded) if self.options.checksum else encoded

    # Loss -----------------------------------------------------------------------------------------------------------

    def _lose(self, reason: str, now_ns: int) -> None:
        self._received_ns = None
        self._stage, self._knows_protocol = Stage.CALLING, False
        self._abandon()
        self._blocks.clear()
        self._watch.forget()
        self._live = LiveClock(CLOCK_WINDOW_S)
        self._wraps = self._stamp = 0
        self.setpoints.lost(now_ns)
        self.telemetry.forget()
        self._console = ""
        self._set_link_state(LinkState.LOST, reason)

    def _describe_silence(self, since: str, why: str) -> str:
        return f"no state{since} from the Crazyflie at {self.options}{why}"

    def _advice(self) -> str:
        if self.options.host.startswith("127."):
            return "start the emulated vehicle: skyloop sim --firmware crazyflie"
        if self.options.kind is LinkKind.RADIO:
            return (
                "switch the vehicle on; check channel, rate and address, and that no other program uses the Crazyradio"
            )
        return "switch the vehicle on and join its Wi-Fi network; or correct the host in the address"


def _ignore(_: CrtpPacket | None) -> None:
    """Ignore an answer, because the parameter's value shows it."""
