"""Eight seconds recorded by a real AR.Drone 2, sent through proxy, transport, a processor and a controller."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import skyloop
from skyloop.errors import UnsupportedError
from skyloop.recording.reader import Recording
from skyloop.vehicles.ardrone.wire.pave import PaveParser
from tests.support.processes import eventually
from tests.support.recordings import recorded

pytestmark = pytest.mark.process


def stream() -> Path:
    return recorded("ardrone2/video-8s.pave")


FRAMES = 240


class Look(skyloop.Controller):
    def __init__(self, drone: skyloop.Drone) -> None:
        super().__init__(drone)
        self.seen: list[int] = []
        self.brightness: list[float] = []

    def on_frame(self, frame: skyloop.Frame) -> None:
        assert frame.shape == (360, 640, 3)
        self.seen.append(frame.seq)
        self.brightness.append(float(np.mean(frame[::8, ::8])))
        if len(self.seen) == FRAMES:
            self.stop()


def test_all_frames_reach_a_processor_and_a_controller_in_order() -> None:
    pytest.importorskip("av", reason="reading recorded video needs PyAV: skyloop install video")
    with skyloop.connect(f"video://{stream()}") as drone:
        with pytest.raises(UnsupportedError, match="record"):
            drone.takeoff()
        processed: list[int] = []
        processor = drone.on_frame(lambda frame: processed.append(frame.seq))
        controller = Look(drone)
        controller.run(seconds=20)
        eventually(lambda: len(processed) + processor.dropped >= FRAMES, "the processor is through as well", 30.0)
    assert processed == sorted(processed)
    assert controller.seen == sorted(controller.seen)
    # Both keep up with 30 frames a second unless the machine suspends them for longer than a frame.
    assert processor.dropped <= FRAMES // 50
    assert len(controller.seen) >= FRAMES - FRAMES // 50
    assert len(set(controller.brightness)) > FRAMES // 2  # the pictures differ


def test_its_h264_reaches_a_recorder_in_another_process_unchanged(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="reading recorded video needs PyAV: skyloop install video")
    path = tmp_path / "flight.mcap"
    with (
        skyloop.connect(f"video://{stream()}?speed=4") as drone,
        skyloop.record(drone, path, min_free_mb=0) as recorder,
    ):
        drone.wait(lambda feedback: feedback.vehicle_link == "closed", timeout_s=30.0)
        closed_s = recorder.status.seconds
        eventually(lambda: recorder.status.seconds > closed_s + 2.0, "what was on the way is written", 30.0)
    recording = Recording.open(path)
    pictures = list(recording.pictures(recording.drone().name, "front"))
    sent = [frame.payload for frame in PaveParser().feed(stream().read_bytes())]
    places = [sent.index(picture.compressed) for picture in pictures]
    assert places == sorted(set(places))
    if not recorder.dropped and not recorder.missed:  # a busy machine may drop some, and reports it
        assert places == list(range(FRAMES))
    assert len(places) >= FRAMES // 4
