"""The topics of a live view, as recordings have them, and what each is made of. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from skyloop.messages import CameraInfo, Capabilities
from skyloop.messages.encoded import H264
from skyloop.recording import foxglove, layout
from skyloop.recording.layout import Channel, FrameRecord, Topic
from skyloop.recording.options import VIDEO

_OTHERS: Final = (Channel.FRAMES, Channel.DROPS)  # a topic for each camera; of files alone


@dataclass(frozen=True, slots=True)
class ViewTopic:
    """A topic that can be subscribed to."""

    name: str
    kind: type[Any]  #: the class of its messages, of :class:`skyloop.recording.output.Message`
    channels: tuple[str, ...]  #: what its drone is subscribed to for it; empty for what is known before
    at_once: bool = True  #: whether it is announced before there is a message

    @property
    def shared(self) -> bool:
        """Whether it is one topic for all drones."""
        return self.name in (layout.TF, layout.LOG)


def topics(drone: str, capabilities: Capabilities, *, far: bool) -> Iterator[ViewTopic]:
    """Yield the topics of a drone.

    Args:
        drone: The drone's name.
        capabilities: Of the drone.
        far: Whether its frames are encoded for the way.
    """
    for channel, kind in layout.TYPES.items():
        if channel not in _OTHERS:
            yield ViewTopic(str(Topic(drone, channel)), kind, (channel.value,))
    state, logs = (Channel.FEEDBACK.value,), (Channel.LOGS.value,)
    yield ViewTopic(layout.pose_topic(drone), foxglove.PoseInFrame, state)
    yield ViewTopic(layout.path_topic(drone), foxglove.PosesInFrame, state)
    yield ViewTopic(layout.TF, foxglove.FrameTransform, state)
    yield ViewTopic(layout.mocap_topic(drone), foxglove.PoseInFrame, logs)
    yield ViewTopic(layout.LOG, foxglove.Log, (Channel.EVENTS.value, *logs))
    for camera in capabilities.cameras:
        yield from _of_camera(drone, camera, far)


def _of_camera(drone: str, camera: CameraInfo, far: bool) -> Iterator[ViewTopic]:
    frames = (f"{VIDEO}.{camera.name}",)
    encoded = far or camera.stream == H264
    yield ViewTopic(str(Topic(drone, Channel.FRAMES, camera.name)), FrameRecord, frames)
    yield ViewTopic(layout.video_topic(drone, camera.name), foxglove.CompressedVideo, frames, encoded)
    yield ViewTopic(layout.image_topic(drone, camera.name), foxglove.CompressedImage, frames, not encoded)
    known = camera.intrinsics is not None
    calibration = layout.calibration_topic(drone, camera.name)
    yield ViewTopic(calibration, foxglove.CameraCalibration, () if known else frames)
    drawings = layout.drawing_topic(drone, camera.name)
    yield ViewTopic(drawings, foxglove.ImageAnnotations, (Channel.ANNOTATIONS.value,))
