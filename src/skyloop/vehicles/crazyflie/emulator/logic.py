"""The emulated firmware's answers to CRTP packets: tables, log blocks, parameters, memories, and versions. Pure."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from skyloop.errors import DecodeError
from skyloop.messages.geometry import quaternion_from_euler, turned
from skyloop.sim.host import Report
from skyloop.vehicles.crazyflie.emulator.flight import CrazyflieFlight
from skyloop.vehicles.crazyflie.emulator.tables import LOG_ROWS, OUT_OF_RANGE_MM, PARAMETER_ROWS, Snapshot, info_of
from skyloop.vehicles.crazyflie.emulator.tables import values as log_values
from skyloop.vehicles.crazyflie.wire import commander as wire
from skyloop.vehicles.crazyflie.wire import contents, crtp
from skyloop.vehicles.crazyflie.wire.contents import CrtpError, LogCommand, LogRequest, MiscCommand, MiscMessage
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket, CrtpPort
from skyloop.vehicles.crazyflie.wire.pictures import DeckState
from skyloop.vehicles.emulation.flight import Vehicle

PROTOCOL: Final = crtp.NEWEST_PROTOCOL
FIRMWARE: Final = "2025.12 (emulated by skyloop)"
DEVICE: Final = "CF21"
BOOT_TEXT: Final = "SYS: ----------------------------\nSYS: Crazyflie 2.1 is up and running!\nSYS: Free to fly\n"
MAX_BLOCKS: Final = 16
MAX_VARIABLES: Final = 128  #: in all log blocks together
_TRAJECTORY_TYPE, _TESTER_TYPE = 0x12, 0x15
_MEMORIES: Final = (_TRAJECTORY_TYPE, _TESTER_TYPE)  # type of each memory
_MEMORY_SIZE: Final = 4096
_MOST_READ: Final = 24  # bytes of a memory in one packet
_NUMBER, _MEMORY_INFO = 1, 2  # requests on MEMORY's first channel
_CONSOLE_BYTES: Final = 30
_STORED, _NOT_STORED = 1, 0
_LOG: Final = {row.entry.number: row.entry for row in LOG_ROWS}
_NUMBERS: Final = {row.entry.full_name: row.entry.number for row in PARAMETER_ROWS}


@dataclass(slots=True)
class Block:
    """A log block: names of variables, and as which types they are sent; ``period_s`` is None while it is stopped."""

    variables: list[tuple[str, contents.ValueType]] = field(default_factory=list)
    period_s: float | None = None
    due_s: float = 0.0


#: First protocol version with a request, if not the oldest: port, channel, first byte.
_SINCE: Final[dict[tuple[int, int, int], int]] = {
    (layout.port, layout.channel, layout.number): layout.since
    for kind in wire.Message.__subclasses__()
    for layout in kind.LAYOUTS
    if layout.number is not None and layout.since > crtp.OLDEST_PROTOCOL
}
_SINCE[CrtpPort.HIGH_LEVEL, 0, 11] = 8  # the spiral


class CrazyflieLogic:
    """A Crazyflie's firmware. Not thread-safe. ``stored`` has the persistent parameters, which survive a restart.

    ``ranges`` measures the distances of the Multi-ranger and the Flow deck [m] by name; it is called only if these are
    logged.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        hover_thrust: float,
        ranges: Callable[[], dict[str, float]],
        stored: dict[int, float],
        *,
        protocol: int = PROTOCOL,
        auto_arm: bool = True,
        number: int = 0xE7,
    ) -> None:
        self._number = number  # last byte of its radio address, by which broadcast poses are addressed
        self.parameters = [stored.get(row.entry.number, row.default) for row in PARAMETER_ROWS]
        self.flight = CrazyflieFlight(vehicle, self.parameter, hover_thrust, auto_arm=auto_arm)
        self._stored, self._ranges, self._protocol = stored, ranges, protocol
        self._hover_thrust = hover_thrust
        self._blocks: dict[int, Block] = {}
        self._report: Report | None = None
        self._boot_s: float | None = None
        self._console = BOOT_TEXT
        self._was_locked = False

    def parameter(self, name: str) -> float:
        return self.parameters[_NUMBERS[name]]

    @property
    def deck_state(self) -> DeckState:
        """What the AI-deck hears of the vehicle."""
        assert self._report is not None
        believed, (x, y, z, yaw) = self._report.believed, self.flight.place
        forward, left, up = believed.velocity_m_s
        velocity = (*turned(forward, left, yaw), up)
        return DeckState(0, (x, y, z), velocity, quaternion_from_euler(believed.roll_rad, believed.pitch_rad, yaw))

    # Packets ---------------------------------------------------------------------------------------------------------

    def receive(self, packet: CrtpPacket) -> list[CrtpPacket]:
        """Handle a packet; return the answers. Never raises, regardless of content."""
        try:
            return list(self._answers(packet))
        except (DecodeError, IndexError, struct.error):
            return []

    def update(self, report: Report, *, talks: bool = True) -> list[CrtpPacket]:
        """Handle the vehicle's newest report and fly; return unsolicited packets. Called regularly.

        Without a client (``talks`` is False), text for the console is kept.
        """
        self._report = report
        time_s = report.believed.time_s
        if self._boot_s is None:
            self._boot_s = time_s
        self.flight.update(report)
        locked = bool(self.flight.supervisor & wire.Supervisor.IS_LOCKED)
        if locked and not self._was_locked:
            self._console += "SUP: Locked, reboot required\n"
        self._was_locked = locked
        return [*self._texts(), *self._log_data(time_s)] if talks else []

    def _texts(self) -> Iterator[CrtpPacket]:
        text, self._console = self._console.encode("ascii"), ""
        for at in range(0, len(text), _CONSOLE_BYTES):
            yield CrtpPacket(CrtpPort.CONSOLE, 0, text[at : at + _CONSOLE_BYTES])

    def _answers(self, packet: CrtpPacket) -> Iterator[CrtpPacket]:
        port, channel, data = packet.port, packet.channel, packet.data
        match port:
            case CrtpPort.LINK:
                if channel == crtp.ECHO:
                    yield packet
                elif channel == crtp.SOURCE:
                    yield CrtpPacket(port, channel, crtp.SOURCE_TEXT.ljust(crtp.MAX_SENT_DATA, b"\0"))
            case CrtpPort.PARAMETERS:
                yield from self._parameter_answers(packet)
            case CrtpPort.LOG:
                yield from self._log_answers(packet)
            case CrtpPort.MEMORY:
                yield from self._memory_answers(packet)
            case CrtpPort.PLATFORM if channel == crtp.VERSION:
                answers: dict[int, int | str] = {0: self._protocol, 1: FIRMWARE, 2: DEVICE}
                if data[0] in answers:
                    yield wire.answer_version(wire.VersionQuery(data[0]), answers[data[0]])
            case CrtpPort.SUPERVISOR if channel == crtp.INFO:
                if 1 <= data[0] <= wire.GET_BITFIELD and self._protocol >= crtp.NEWEST_PROTOCOL:
                    yield wire.answer_supervisor(data[0], self.flight.supervisor)
            case _:
                yield from self._command_answers(packet)

    def _command_answers(self, packet: CrtpPacket) -> Iterator[CrtpPacket]:
        for number, place, quaternion in wire.decode_packed_poses(packet):
            if number == self._number:
                x, y, z = place
                qx, qy, qz, qw = quaternion
                self.flight.handle(wire.ExternalPoseMessage(x, y, z, qx, qy, qz, qw))
        high_level = packet.port == CrtpPort.HIGH_LEVEL
        try:
            since = _SINCE.get((packet.port, packet.channel, packet.data[0])) if packet.data else None
            message = None if since is not None and self._protocol < since else wire.decode_message(packet)
        except DecodeError:
            if not high_level:
                raise
            message = None
        if isinstance(message, wire.Arm):
            armed = self.flight.arm(message.arm)
            bits = self.flight.supervisor
            yield wire.answer_arm(packet, success=armed, armed=bool(bits & wire.Supervisor.IS_ARMED))
        elif isinstance(message, wire.Recover):
            recovered = self.flight.recover()
            crashed = bool(self.flight.supervisor & wire.Supervisor.IS_CRASHED)
            yield wire.answer_arm(packet, success=recovered, armed=not crashed)
        elif message is not None or high_level:
            error = CrtpError.NOT_EXECUTABLE if message is None else self.flight.handle(message)
            if high_level:  # answered by the start of the request, and the result
                yield CrtpPacket(packet.port, packet.channel, packet.data[:3].ljust(3, b"\0") + bytes((error,)))

    # Parameters ------------------------------------------------------------------------------------------------------

    def _parameter_answers(self, packet: CrtpPacket) -> Iterator[CrtpPacket]:
        if packet.channel == crtp.CONTENTS:
            number = contents.decode_question(packet)
            if number is None:
                yield contents.answer_info(CrtpPort.PARAMETERS, info_of(PARAMETER_ROWS))
            else:
                entry = PARAMETER_ROWS[number].entry if number < len(PARAMETER_ROWS) else None
                yield contents.answer_item(CrtpPort.PARAMETERS, entry)
        elif packet.channel == crtp.MISCELLANEOUS:
            yield self._miscellaneous(packet)
        else:
            number, data = contents.decode_parameter(packet)
            if packet.channel == crtp.READ:
                known = number < len(PARAMETER_ROWS)
                value = self._encoded(number) if known else b""
                yield contents.answer_read(number, value, 0 if known else CrtpError.NO_ENTRY)
            else:
                error = self._write(number, data)
                if error != CrtpError.NO_ACCESS:  # the firmware does not answer then
                    yield contents.write_parameter(number, bytes((error,)) if error else self._encoded(number))

    def _encoded(self, number: int) -> bytes:
        return PARAMETER_ROWS[number].entry.type.encode(self.parameters[number])

    def _write(self, number: int, data: bytes) -> int:
        if number >= len(PARAMETER_ROWS):
            return CrtpError.NO_ENTRY
        entry = PARAMETER_ROWS[number].entry
        if entry.read_only:
            return CrtpError.NO_ACCESS
        try:
            value = entry.type.decode(data[: entry.type.size])
        except DecodeError:
            return CrtpError.INVALID
        if not math.isfinite(value):
            return CrtpError.INVALID
        self.parameters[number] = value
        if value and entry.full_name in ("kalman.resetEstimation", "ukf.resetEstimation"):
            self.flight.reset_estimate()
        return CrtpError.NONE

    def _miscellaneous(self, packet: CrtpPacket) -> CrtpPacket:
        if packet.data[0] == MiscCommand.SET_BY_NAME:
            group, name, type_, data = contents.decode_set_by_name(packet)
            number = _NUMBERS.get(f"{group}.{name}", len(PARAMETER_ROWS))
            wrong = number < len(PARAMETER_ROWS) and PARAMETER_ROWS[number].entry.type != type_ & 0x0F
            error = CrtpError.INVALID if wrong else self._write(number, data)
            return contents.answer_set_by_name(group, name, error)
        request = MiscMessage.decode(packet)
        return MiscMessage(request.command, request.number, self._about(request.command, request.number)).encode()

    def _about(self, command: MiscCommand, number: int) -> bytes:
        if number >= len(PARAMETER_ROWS):
            return bytes((CrtpError.NO_ENTRY,))
        row = PARAMETER_ROWS[number]
        default = row.entry.type.encode(row.default)
        extended = bytes((contents.PERSISTENT * row.entry.extended,))
        match command:
            case MiscCommand.GET_EXTENDED_TYPE:
                return extended if row.entry.extended else bytes((CrtpError.NO_ENTRY,))
            case MiscCommand.GET_EXTENDED_TYPE_2:
                return b"\0" + extended
            case MiscCommand.GET_DEFAULT:
                return bytes((CrtpError.NO_ENTRY,)) if row.entry.read_only else default
            case MiscCommand.GET_DEFAULT_2:
                return bytes((CrtpError.NO_ENTRY,)) if row.entry.read_only else b"\0" + default
        if not row.entry.extended:
            return bytes((CrtpError.NO_ENTRY,))
        match command:
            case MiscCommand.STORE:
                self._stored[number] = self.parameters[number]
            case MiscCommand.CLEAR:
                self._stored.pop(number, None)
            case MiscCommand.GET_STATE:
                if number in self._stored:
                    return bytes((_STORED,)) + default + row.entry.type.encode(self._stored[number])
                return bytes((_NOT_STORED,)) + default
        return bytes((CrtpError.NONE,))

    # Log -------------------------------------------------------------------------------------------------------------

    def _log_answers(self, packet: CrtpPacket) -> Iterator[CrtpPacket]:
        if packet.channel == crtp.CONTENTS:
            number = contents.decode_question(packet)
            if number is None:
                yield contents.answer_info(CrtpPort.LOG, info_of(LOG_ROWS, MAX_BLOCKS, MAX_VARIABLES))
            else:
                yield contents.answer_item(CrtpPort.LOG, _LOG.get(number))
        elif packet.channel == crtp.CONTROL:
            try:
                request = LogRequest.decode(packet)
            except DecodeError:
                head = packet.data[:2].ljust(2, b"\0")
                yield CrtpPacket(packet.port, packet.channel, head + bytes((CrtpError.NOT_EXECUTABLE,)))
            else:
                yield contents.answer_log(request, self._control(request))

    def _control(self, request: LogRequest) -> int:
        blocks, block = self._blocks, self._blocks.get(request.block)
        match request.command:
            case LogCommand.RESET:
                blocks.clear()
                return CrtpError.NONE
            case LogCommand.CREATE:
                if block is not None:
                    return CrtpError.EXISTS
                if len(blocks) >= MAX_BLOCKS:
                    return CrtpError.NO_MEMORY
                block = blocks[request.block] = Block()
                return self._append(block, request)
        if block is None:
            return CrtpError.NO_ENTRY
        match request.command:
            case LogCommand.APPEND:
                return self._append(block, request)
            case LogCommand.DELETE:
                del blocks[request.block]
            case LogCommand.START:
                block.period_s = max(request.period_ms, contents.PERIOD_UNIT_MS) / 1000
                block.due_s = 0.0
            case LogCommand.STOP:
                block.period_s = None
        return CrtpError.NONE

    def _append(self, block: Block, request: LogRequest) -> int:
        if any(number not in _LOG for number, _ in request.variables):
            return CrtpError.NO_ENTRY
        variables = [(_LOG[number].full_name, type_) for number, type_ in request.variables]
        if sum(type_.size for _, type_ in (*block.variables, *variables)) > contents.MAX_LOGGED:
            return CrtpError.TOO_BIG
        if sum(len(each.variables) for each in self._blocks.values()) + len(variables) > MAX_VARIABLES:
            return CrtpError.NO_MEMORY
        block.variables += variables
        return CrtpError.NONE

    def _log_data(self, time_s: float) -> Iterator[CrtpPacket]:
        assert self._boot_s is not None
        due = {
            number: block
            for number, block in self._blocks.items()
            if block.period_s is not None and time_s >= block.due_s - 1e-6
        }
        if not due:
            return
        ranging = any(name.startswith("range.") for block in due.values() for name, _ in block.variables)
        shown = log_values(self._snapshot(ranging))
        for number, block in due.items():
            assert block.period_s is not None
            block.due_s = max(block.due_s + block.period_s, time_s)
            data = b"".join(_limited(type_, shown.get(name, 0.0)) for name, type_ in block.variables)
            yield contents.log_data(number, round(1000 * (time_s - self._boot_s)), data)

    def _snapshot(self, ranging: bool) -> Snapshot:
        assert self._report is not None
        believed, truth, flight = self._report.believed, self._report.truth, self.flight
        x, y, z, yaw = flight.place
        quaternion = quaternion_from_euler(believed.roll_rad, believed.pitch_rad, yaw)
        ranges = self._ranges() if ranging else {}
        target, velocity = flight.target.place, flight.target.velocity
        return Snapshot(
            believed=believed,
            place_m=(x, y, z),
            yaw_rad=yaw,
            quaternion=quaternion,
            target_m=target[:3],
            target_velocity_m_s=velocity[:3],
            target_yaw_rad=target[3],
            supervisor=flight.supervisor,
            thrust=truth.thrust * self._hover_thrust,
            external_m=flight.external_m,
            ranges_mm={name: min(OUT_OF_RANGE_MM, round(1000 * min(m, 99.0))) for name, m in ranges.items()},
            packed_quaternion=wire.compressed(quaternion),
        )

    # Memories --------------------------------------------------------------------------------------------------------

    def _memory_answers(self, packet: CrtpPacket) -> Iterator[CrtpPacket]:
        data = packet.data
        if packet.channel == crtp.MEMORY_INFO:
            if data[0] == _NUMBER:
                yield CrtpPacket(packet.port, packet.channel, bytes((_NUMBER, len(_MEMORIES))))
            elif data[0] == _MEMORY_INFO:
                row = b"" if data[1] >= len(_MEMORIES) else struct.pack("<BIQ", _MEMORIES[data[1]], _MEMORY_SIZE, 0)
                yield CrtpPacket(packet.port, packet.channel, data[:2] + row)
            return
        number, address = struct.unpack_from("<BI", data)
        reads = packet.channel == crtp.MEMORY_READ
        length = data[5] if reads else len(data) - 5
        fits = number < len(_MEMORIES) and address + length <= _MEMORY_SIZE and length <= _MOST_READ + 1
        status = bytes((CrtpError.NONE if fits else 5,))  # EIO
        content = b""
        if fits and reads:
            content = self._read(number, address, length)
        elif fits and _MEMORIES[number] == _TRAJECTORY_TYPE:
            self.flight.memory[address : address + length] = data[5:]
        yield CrtpPacket(packet.port, packet.channel, data[:5] + status + content)

    def _read(self, number: int, address: int, length: int) -> bytes:
        if _MEMORIES[number] == _TRAJECTORY_TYPE:
            return bytes(self.flight.memory[address : address + length])
        return bytes(place & 0xFF for place in range(address, address + length))


def _limited(type_: contents.ValueType, value: float) -> bytes:
    low, high = type_.limits
    return type_.encode(max(low, min(high, value)))
