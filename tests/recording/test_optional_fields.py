"""Each optional field of every message is left out once, by introspection, and the message passes all its readers.

A field with a default is optional: an older program does not send it, and a vehicle that does not know it leaves it
out. New fields are tested here automatically.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from skyloop.clock import ManualClock
from skyloop.cockpit.telemetry import event_values, feedback_values, flat_values, set_point_values
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.messages import AnyAction, Applied, Command, Event, Feedback, LinkState, Sample
from skyloop.messages.codec import decode, encode
from skyloop.recording import layout
from skyloop.recording.backlog import Item, Rank
from skyloop.recording.layout import (
    TYPES,
    Channel,
    ClockPair,
    DroneRecord,
    Drops,
    End,
    FrameRecord,
    ResultRecord,
    Start,
)
from skyloop.recording.reader import Recording
from skyloop.recording.review.compare import compare
from skyloop.recording.review.report import write_report
from skyloop.recording.review.tables import export_csv, export_npz, export_parquet, read
from skyloop.recording.translation import Message, TranslatedImage, Translator
from skyloop.recording.writer import RecordingFile
from skyloop.vehicles.replay.player import Playback, StepPlayer
from skyloop.vehicles.replay.source import ReplaySource
from tests.support.recorded_flights import BEGIN_NS, CAPABILITIES, UNIX_NS, Plan, feedback_at, picture_at
from tests.support.samples import SAMPLES, TILT

CLOCK = ClockPair(BEGIN_NS, UNIX_NS, 1)


def variants(full: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield a message unchanged, without each optional field, and without all of them; its parts likewise."""
    optional = {}
    for field in msgspec.structs.fields(full):
        value = getattr(full, field.name)
        for name, part in variants(value, f"{path}{field.name}.") if isinstance(value, msgspec.Struct) else ():
            yield name, msgspec.structs.replace(full, **{field.name: part})
        if field.default is not msgspec.NODEFAULT:
            optional[field.name] = field.default
        elif field.default_factory is not msgspec.NODEFAULT:
            optional[field.name] = field.default_factory()
    absent = {name: {name: default} for name, default in optional.items()} | {"all": optional}
    for name, fields in absent.items():
        with suppress(ValueError):  # a log entry needs one of its values
            yield path + name, msgspec.structs.replace(full, **fields)


def cases(samples: dict[str, Any]) -> dict[str, Any]:
    found = {}
    for name, sample in samples.items():
        found[name] = sample
        found |= {f"{name} without {path}": one for path, one in variants(sample)}
    return found


def actions() -> dict[str, AnyAction]:
    """Return the fullest sample of each action."""
    commands = [one for name, one in SAMPLES.items() if isinstance(one, Command) and "minimal" not in name]
    found = {command.action.name: command.action for command in commands}
    assert {type(action) for action in found.values()} == set(get_args(AnyAction))
    return found


def recorded() -> dict[str, Any]:
    """Return a full sample of everything recorded."""
    full: dict[str, Any] = {
        name: one for name, one in SAMPLES.items() if type(one) in TYPES.values() and "minimal" not in name
    }
    full |= {
        f"applied {name}": Applied(8, 7, 2, BEGIN_NS, BEGIN_NS + 1, action, action)
        for name, action in actions().items()
    }
    header = SAMPLES["frame"]
    full |= {
        "parameter": TILT,
        "frame": FrameRecord(header, 3_000_600_000, "jpeg"),  # type: ignore[arg-type]
        "result": ResultRecord("detector", 3, 4, "front", 12, BEGIN_NS, BEGIN_NS + 5, 35, {"score": 0.5}),
        "drops": Drops(BEGIN_NS, {"feedback": 1}, {"video.front": 2}),
    }
    assert {type(one) for one in full.values()} == set(TYPES.values())
    return full


WIRE = cases(SAMPLES)
FILE = cases(recorded())


@pytest.mark.parametrize("name", WIRE)
def test_an_absent_field_passes_the_wire(name: str) -> None:
    sample: Sample = WIRE[name]
    again = decode(encode(sample))
    assert encode(again) == encode(sample)


def shifted(sample: Any) -> Any:
    """Return the sample with times within the recording."""
    names = ("captured_ns", "published_ns", "at_ns", "applied_ns", "sent_ns", "made_ns")
    times = {name: BEGIN_NS + 1 for name in names if getattr(sample, name, None)}
    if isinstance(sample, FrameRecord):
        times = {"header": shifted(sample.header)}
    return msgspec.structs.replace(sample, **times)


def write(path: Path, sample: Any) -> Recording:
    """Write a recording of a state, the sample, and two more states."""
    clock_ns = BEGIN_NS
    translator = Translator("alpha", CAPABILITIES, CLOCK)
    file = RecordingFile(path, Start(layout.VERSION, "0.1", (record(),), UNIX_NS), CLOCK)
    written: list[Any] = [feedback_at(Plan(), 0, 1), shifted(sample)]
    written += [feedback_at(Plan(), at_ms, at_ms // 20 + 1) for at_ms in (20, 40)]
    for number, one in enumerate(written):
        clock_ns += 5_000_000
        if isinstance(one, FrameRecord):
            one = TranslatedImage(one, jpeg())
        if isinstance(one, ResultRecord):  # it is made from a packed result, which has its own tests
            topic = f"/alpha/{Channel.RESULTS}"
            file.write(Message(topic, ResultRecord, layout.encode(one), CLOCK.unix(clock_ns), CLOCK.unix(clock_ns)))
            continue
        for message in translator.messages(Item(0, "any", Rank.KEPT, clock_ns, one, number)):
            file.write(message)
    file.close(End("closed", CLOCK.unix(clock_ns), dict(file.written)))
    return Recording.open(path)


def record() -> DroneRecord:
    return DroneRecord("alpha", "sim://", layout.to_plain(CAPABILITIES))


def jpeg() -> bytes:
    import cv2

    return cv2.imencode(".jpg", picture_at(1))[1].tobytes()


@pytest.mark.parametrize("name", FILE)
def test_an_absent_field_is_recorded_replayed_and_exported(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The replay of a flight with "Fly there" ended in a TypeError about a yaw of None."""
    sample = FILE[name]
    recording = write(tmp_path / "flight.mcap", sample)
    assert not recording.cut
    for item in recording.items("alpha"):
        if type(item.value) is type(sample) and not isinstance(sample, Feedback):
            assert layout.encode(item.value) == layout.encode(shifted(sample)), "the sample reads back unchanged"
    sink = RecordingSink()
    clock = ManualClock(BEGIN_NS)
    # By the computer's own clock, the flight is in the future of one that started less than 5,000 s ago.
    monkeypatch.setattr("skyloop.drivers.recording_sink.monotonic_ns", clock)
    player = StepPlayer(ReplaySource(recording, recording.drone("alpha")), sink, clock, Playback(1.0, in_step=True))
    player.begin()
    while player.due_ns is not None:
        clock.now_ns = max(clock(), player.due_ns)
        player.step()
    assert sink.link_state is LinkState.CLOSED
    assert not sink.problems
    for feedback in sink.feedbacks:  # as for the replay's own recording and the page
        assert layout.decode(layout.encode(feedback), Feedback).captured_ns == feedback.captured_ns
        json.dumps([feedback_values(feedback, clock()), flat_values(feedback, {}, None)], allow_nan=False)
    if isinstance(sample, Applied):
        values = (sink.feedbacks[-1].native or {})["replay.applied.values"]
        assert isinstance(values, tuple)
        given = [getattr(sample.applied, field) for field in sample.applied.__struct_fields__]
        assert values == pytest.approx([math.nan if one is None else float(one) for one in given], nan_ok=True)
        json.dumps([set_point_values(sample.applied, 0.1), flat_values(None, {}, sample.applied)], allow_nan=False)
    elif isinstance(sample, Event):
        json.dumps(event_values(1, sample, clock()), allow_nan=False)
    exported(recording, tmp_path)


def exported(recording: Recording, folder: Path) -> None:
    found = read(recording, "alpha", None)
    export_csv(found, folder / "csv")
    export_npz(found, folder / "flight.npz")
    export_parquet(found, folder / "parquet")
    write_report(recording, "alpha", folder / "report.html")
    if "commands" in found:
        compare(recording, recording)
