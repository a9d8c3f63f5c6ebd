"""Small recordings, written with the plain MCAP library according to the documented layout."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import msgspec
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.writer import CompressionType, Writer

from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    Applied,
    CameraInfo,
    Capabilities,
    Encoding,
    Event,
    EventKind,
    Failsafe,
    Feedback,
    FlightState,
    FrameHeader,
    Intrinsics,
    Land,
    LinkState,
    LogEntry,
    Parameter,
    ParameterType,
    Position,
    Severity,
    Takeoff,
    Value,
    Velocity,
)
from skyloop.recording.layout import (
    META_CLOCK,
    META_END,
    META_RECORDING,
    PROFILE,
    TYPES,
    VERSION,
    Channel,
    ClockPair,
    DroneRecord,
    Drops,
    End,
    FrameRecord,
    ResultRecord,
    Start,
    Topic,
    encode,
    image_topic,
    schema,
    schema_name,
    to_metadata,
    to_plain,
)

MS = 1_000_000
BEGIN_NS = 5_000_000_000_000  #: start of the flight on the proxy's clock
UNIX_NS = 1_760_000_000_000_000_000  #: the same moment in Unix time
WIDTH, HEIGHT = 64, 48
INTRINSICS = Intrinsics(60.0, 60.0, 31.5, 23.5)
CAPABILITIES = Capabilities(
    "sim",
    frozenset(ACTION_NAMES.values()) - {"idle"},
    (CameraInfo("front", WIDTH, HEIGHT, 10.0, intrinsics=INTRINSICS),),
    "a simulated quadrotor",
)


@dataclass
class Plan:
    """The contents of a recording."""

    seconds: float = 2.0
    feedback_ms: int = 20
    frame_ms: int = 100  #: 0 for no frames
    command_ms: int = 50
    gain: float = 1.0  #: factor of the commanded speeds
    drone: str = "alpha"
    png: bool = False
    lossy: bool = True  #: whether it reports drops and has a gap in the feedback
    capabilities: Capabilities = CAPABILITIES
    compression: CompressionType = CompressionType.ZSTD
    chunk_size: int = 16 * 1024
    closed: bool = True
    places: bool = False  #: whether it flies to a position instead of by velocity
    shift_ns: int = 0  #: shift of the commands on the proxy's clock
    extra: Callable[[int], Feedback | None] = field(default=lambda at_ms: None)  #: replaces the feedback at a time
    packed: Callable[[int], bytes | None] = field(default=lambda number: None)  #: replaces the file of a picture


def state_at(seconds: float, t: float) -> FlightState:
    """Return the state at a time: landed, taking off, flying, landing, landed."""
    share = t / seconds
    if share < 0.1 or share > 0.95:
        return FlightState.LANDED
    if share < 0.25:
        return FlightState.TAKING_OFF
    return FlightState.FLYING if share < 0.8 else FlightState.LANDING


def feedback_at(plan: Plan, at_ms: int, seq: int) -> Feedback:
    """Return feedback on a circle of 1 m around (1, 2) that climbs to 1.2 m."""
    t = at_ms / 1000
    angle = t * 1.2
    high = 1.2 * max(0.0, min(1.0, (t / plan.seconds - 0.1) / 0.15, (0.95 - t / plan.seconds) / 0.15))
    at_ns = BEGIN_NS + at_ms * MS
    return Feedback(
        captured_ns=at_ns - 4 * MS,
        state=state_at(plan.seconds, t),
        battery=1.0 - 0.1 * t / plan.seconds,
        roll_rad=0.1 * math.sin(angle),
        pitch_rad=0.08 * math.cos(angle),
        yaw_rad=math.remainder(angle, math.tau),
        altitude_m=high,
        velocity_m_s=(0.4, 0.1 * math.sin(angle), 0.0),
        position_m=(1.0 + math.cos(angle), 2.0 + math.sin(angle), high),
        native={"motor": 0.5, "note": "fine"},
        seq=seq,
        published_ns=at_ns,
        vehicle_link=LinkState.UP,
        owner="pilot.py",
        owner_id=3,
        owner_priority=16,
        lease=2,
        failsafe=Failsafe.NONE,
    )


def action_at(plan: Plan, at_ms: int) -> AnyAction:
    share = at_ms / 1000 / plan.seconds
    if share < 0.25:
        return Takeoff()
    if share > 0.8:
        return Land()
    if plan.places:
        return Position(1.0, 2.0, 1.2 * plan.gain)
    return Velocity(forward=0.4 * plan.gain, left=0.1 * math.sin(at_ms / 300))


def picture_at(number: int) -> np.ndarray:
    """Return a grey ramp with a bright column that moves."""
    image = np.repeat(np.linspace(20, 120, WIDTH, dtype=np.uint8)[None, :, None], HEIGHT, 0).repeat(3, 2)
    image[:, (number * 3) % WIDTH] = (40, 200, 250)
    return image


class Tape:
    """An MCAP file that is being written."""

    def __init__(self, path: Path, plan: Plan) -> None:
        self._plan = plan
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=plan.chunk_size, compression=plan.compression)
        self._writer.start(PROFILE, "tests")
        self._channels: dict[str, int] = {}
        self._numbers: dict[str, int] = {}
        clock = ClockPair(BEGIN_NS, UNIX_NS, 77)
        drone = DroneRecord(plan.drone, "sim://", to_plain(plan.capabilities))
        self._writer.add_metadata(META_CLOCK, to_metadata(clock))
        start = Start(VERSION, "0.1.0", (drone,), UNIX_NS)
        self._writer.add_metadata(META_RECORDING, to_metadata(start))

    def own(self, channel: Channel, sample: msgspec.Struct, log_ms: float, publish_ms: float, camera: str = "") -> None:
        topic = str(Topic(self._plan.drone, channel, camera))
        if topic not in self._channels:
            kind = TYPES[channel]
            number = self._writer.register_schema(schema_name(kind), "jsonschema", schema(kind))
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        self._add(topic, encode(sample), log_ms, publish_ms)

    def image(self, camera: str, data: bytes, format_: str, log_ms: float, publish_ms: float) -> None:
        topic = image_topic(self._plan.drone, camera)
        if topic not in self._channels:
            number = self._writer.register_schema("foxglove.CompressedImage", "protobuf", b"")
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", number)
        message = CompressedImage(frame_id=f"{self._plan.drone}/{camera}", data=data, format=format_)
        self._add(topic, message.SerializeToString(), log_ms, publish_ms)

    def _add(self, topic: str, data: bytes, log_ms: float, publish_ms: float) -> None:
        number = self._numbers[topic] = self._numbers.get(topic, 0) + 1
        self._writer.add_message(
            self._channels[topic], UNIX_NS + round(log_ms * MS), data, UNIX_NS + round(publish_ms * MS), number
        )

    def close(self) -> None:
        if self._plan.closed:
            end = End("closed", UNIX_NS + round(self._plan.seconds * 1000) * MS, dict(self._numbers))
            self._writer.add_metadata(META_END, to_metadata(end))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()


def write_flight(path: Path, plan: Plan | None = None) -> Path:
    """Write a flight in which every kind of sample occurs."""
    plan = plan or Plan()
    tape = Tape(path, plan)
    for parameter in (
        Parameter("limits.tilt", ParameterType.FLOAT, 0.35, "rad", 0.0, 1.0, 0.35),
        Parameter("sim.battery", ParameterType.FLOAT, 1.0, "", 0.0, 1.0),
    ):
        tape.own(Channel.PARAMETERS, parameter, 0.0, 0.0)
    for at_ms in range(round(plan.seconds * 1000)):
        _moment(tape, plan, at_ms)
    tape.close()
    return path


def _moment(tape: Tape, plan: Plan, at_ms: int) -> None:
    at_ns = BEGIN_NS + at_ms * MS
    half = round(plan.seconds * 500)
    gap = plan.lossy and half < at_ms < half + 5 * plan.feedback_ms
    if at_ms % plan.feedback_ms == 0 and not gap:
        sample = plan.extra(at_ms) or feedback_at(plan, at_ms, at_ms // plan.feedback_ms + 1)
        tape.own(Channel.FEEDBACK, sample, at_ms + 0.2, (sample.captured_ns - BEGIN_NS) / MS)
    if plan.command_ms and at_ms % plan.command_ms == 10:
        number = at_ms // plan.command_ms + 1
        asked = action_at(plan, at_ms)
        sent_ns = at_ns + plan.shift_ns
        echo = Applied(number, 2, 3, sent_ns, sent_ns + MS // 2, asked, asked)
        tape.own(Channel.COMMANDS, echo, at_ms + 0.6, at_ms)
    if plan.frame_ms and at_ms % plan.frame_ms == 5:
        _frame(tape, plan, at_ms)
    for event in _events(plan, at_ms):
        tape.own(Channel.EVENTS, event, at_ms + 0.3, at_ms)
    if at_ms == half:
        tape.own(Channel.PARAMETERS, Parameter("limits.tilt", ParameterType.FLOAT, 0.2, "rad"), at_ms, at_ms)
        tape.own(Channel.LOGS, LogEntry("pilot.py", "error", at_ns, number=0.25), at_ms + 0.1, at_ms)
        tape.own(Channel.LOGS, LogEntry("pilot.py", "", at_ns, text="half way"), at_ms + 0.1, at_ms)
        tape.own(Channel.LOGS, LogEntry("pilot.py", "gains", at_ns, values=(1.0, 2.0), shape=(2,)), at_ms + 0.1, at_ms)
        found = {"score": 0.5, "boxes": [[1, 2]]}
        result = ResultRecord("detector", 4, 1, "front", 3, at_ns - 30 * MS, at_ns, 20 * MS, found)
        tape.own(Channel.RESULTS, result, at_ms + 0.1, at_ms - 30)
        if plan.lossy:
            tape.own(Channel.DROPS, Drops(at_ns, {"video.front": 2}, {"feedback": 4}), at_ms, at_ms)


def _frame(tape: Tape, plan: Plan, at_ms: int) -> None:
    number = at_ms // plan.frame_ms + 1
    at_ns = BEGIN_NS + at_ms * MS
    header = FrameHeader(
        "front", number, at_ns - 30 * MS, at_ns, WIDTH, HEIGHT, Encoding.BGR8, WIDTH * HEIGHT * 3, INTRINSICS
    )
    form = "png" if plan.png else "jpeg"
    record = FrameRecord(header, at_ns + MS, form)
    packed = plan.packed(number) or cv2.imencode(".png" if plan.png else ".jpg", picture_at(number))[1].tobytes()
    tape.own(Channel.FRAMES, record, at_ms + 1.0, at_ms - 30, "front")
    tape.image("front", packed, form, at_ms + 1.0, at_ms - 30)


def _events(plan: Plan, at_ms: int) -> Iterator[Event]:
    at_ns = BEGIN_NS + at_ms * MS
    if at_ms == 0:
        data: dict[str, Value] = {"app_id": 3, "priority": 16, "lease": 2}
        yield Event(EventKind.AUTHORITY_GRANTED, "pilot.py has the authority", at_ns, seq=1, app="pilot.py", data=data)
    step = round(plan.seconds * 1000)
    before, after = state_at(plan.seconds, (at_ms - 1) / 1000), state_at(plan.seconds, at_ms / 1000)
    if at_ms and before is not after:
        data = {"before": before.value, "after": after.value}
        yield Event(EventKind.STATE_CHANGED, f"{before.value} → {after.value}", at_ns, seq=2, data=data)
    if at_ms == step * 6 // 10:
        yield Event(EventKind.COLLISION, "touched a chair", at_ns, Severity.WARNING, 3, data={"speed_m_s": 0.3})
        yield Event(EventKind.FAILSAFE, "failsafe: hover", at_ns, Severity.WARNING, 4, data={"step": "hover"})
