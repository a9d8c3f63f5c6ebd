"""What is taken from a drone: samples go from the receiving thread into the backlog, pictures by way of an encoder."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.client import Drone
from skyloop.client.delivery import Listener
from skyloop.client.frame import Arrival, to_bgr
from skyloop.client.slots import Buffer
from skyloop.errors import MissingExtraError, SkyloopError
from skyloop.logfile.layout import Channel, Drops, FrameRecord
from skyloop.messages import (
    Annotation,
    Applied,
    Encoding,
    Event,
    EventKind,
    Feedback,
    FrameHeader,
    LinkState,
    LogEntry,
    Parameter,
    Severity,
)
from skyloop.recording.backlog import Backlog, Item, Rank
from skyloop.recording.options import VIDEO, Options
from skyloop.recording.translation import Picture

_FRAMES_WAITING: Final = 2  # a third is being encoded, a fourth on the way: more are not lent to one application
_SIZE: Final = 400  #: bytes of an ordinary sample, roughly
_PARAMETERS_S: Final = 2.0  # after a change that this could not ask for, it is asked again

Encode = Callable[[FrameHeader, "NDArray[np.uint8]"], bytes]


class Gaps:
    """Counts what is missing in rising numbers. A number that is not higher begins anew."""

    def __init__(self) -> None:
        self.missed = 0
        self._last: int | None = None

    def follow(self, number: int) -> None:
        last = self._last
        if last is not None and number > last + 1:
            self.missed += number - last - 1
        self._last = number


class Tap:
    """One drone's samples. ``number`` is the drone's within the recording."""

    def __init__(self, number: int, drone: Drone, options: Options, backlog: Backlog) -> None:
        self.drone = drone
        self._number = number
        self._options = options
        self._backlog = backlog
        self._listeners: list[Listener[Any]] = []
        self._gaps = {Channel.FEEDBACK.value: Gaps(), Channel.EVENTS.value: Gaps()}
        self._videos = [
            Video(self._put, drone, camera.name, options)
            for camera in drone.capabilities.cameras
            if options.wants_camera(camera.name)
        ]
        self._parameters = Parameters(drone, self.put_parameter) if options.wants(Channel.PARAMETERS) else None

    def start(self) -> None:
        """Begin to listen."""
        drone, wants = self.drone, self._options.wants
        listen: tuple[tuple[Channel, Callable[..., Listener[Any]], Callable[[Any], None]], ...] = (
            (Channel.FEEDBACK, drone.on_feedback, self._feedback),
            (Channel.EVENTS, drone.on_event, self._event),
            (Channel.COMMANDS, drone.on_command, self._applied),
            (Channel.ANNOTATIONS, drone.on_annotation, self._annotation),
            (Channel.LOGS, drone.on_log, self._log),
        )
        for channel, subscribe, sink in listen:
            if wants(channel):
                self._listeners.append(subscribe(sink, inline=True))
        if self._parameters is not None:
            self._listeners.append(drone.on_event(self._parameters.event, inline=True))
            self._parameters.start()
        for video in self._videos:
            video.start()

    def stop(self) -> None:
        """Listen no more; what came before is in the backlog when this returns."""
        for listener in self._listeners:
            listener.cancel()
        if self._parameters is not None:
            self._parameters.stop()
        for video in self._videos:
            video.stop()

    def dropped(self) -> dict[str, int]:
        """By channel, what was received and left out."""
        found = {
            channel: count for (number, channel), count in list(self._backlog.dropped.items()) if number == self._number
        }
        for video in self._videos:
            if video.dropped:
                found[video.channel] = found.get(video.channel, 0) + video.dropped
        return found

    def missed(self) -> dict[str, int]:
        """By channel, what was never received."""
        gaps = self._gaps | {video.channel: video.gaps for video in self._videos}
        return {channel: gap.missed for channel, gap in gaps.items() if gap.missed}

    def put_drops(self, dropped: dict[str, int], missed: dict[str, int]) -> None:
        now_ns = time.monotonic_ns()
        self._put("drops", Rank.KEPT, Drops(now_ns, dropped, missed), _SIZE, now_ns)

    def put_event(self, text: str, severity: Severity, data: dict[str, str]) -> None:
        """An event of the recorder's own, into the file."""
        now_ns = time.monotonic_ns()
        at_ns = now_ns + self.drone.clock_offset_ns
        event = Event(EventKind.RECORDING, text, at_ns, severity, app="recorder", data=dict(data))
        self._put(Channel.EVENTS.value, Rank.KEPT, event, _SIZE, now_ns)

    def put_parameter(self, parameter: Parameter) -> None:
        self._put(Channel.PARAMETERS.value, Rank.KEPT, parameter, _SIZE)

    # On the receiving thread -----------------------------------------------------------------------------------

    def _put(self, channel: str, rank: Rank, sample: Any, size: int, now_ns: int = 0) -> None:
        self._backlog.put(Item(self._number, channel, rank, now_ns or time.monotonic_ns(), sample, size))

    def _feedback(self, feedback: Feedback) -> None:
        self._gaps["feedback"].follow(feedback.seq)
        native = feedback.native
        self._put("feedback", Rank.STATE, feedback, _SIZE + (40 * len(native) if native else 0))

    def _event(self, event: Event) -> None:
        if event.seq:  # those of the client's own have none
            self._gaps["events"].follow(event.seq)
        if event.kind is not EventKind.RECORDING:  # the recorder's own get there by put_event
            self._put("events", Rank.KEPT, event, _SIZE)

    def _applied(self, applied: Applied) -> None:
        self._put("commands", Rank.KEPT, applied, _SIZE)

    def _annotation(self, annotation: Annotation) -> None:
        self._put("annotations", Rank.STATE, annotation, _SIZE + 100 * len(annotation.shapes))

    def _log(self, entry: LogEntry) -> None:
        self._put("logs", Rank.KEPT, entry, _SIZE + len(entry.text or "") + 10 * len(entry.values or ()))


class Video:
    """One camera's frames: encoded on a thread of their own, unless they come as JPEG."""

    def __init__(self, put: Callable[..., None], drone: Drone, camera: str, options: Options) -> None:
        self.channel = f"{VIDEO}.{camera}"
        self.gaps = Gaps()
        self._put = put
        self._topic = drone.channel(camera).topic
        self._encode = encoder(options)
        self._format = options.encoding
        self._failed = 0
        self._buffer: Buffer[Arrival] = Buffer(_FRAMES_WAITING)
        self._sink = self._arrived
        self._thread = threading.Thread(target=self._run, name=f"skyloop-record-{camera}", daemon=True)

    @property
    def dropped(self) -> int:
        """Frames that the encoder had no time for, or could make nothing of."""
        return self._buffer.dropped + self._failed

    def start(self) -> None:
        self._thread.start()
        self._topic.add(self._sink, lambda: 0)

    def stop(self) -> None:
        self._topic.remove(self._sink)
        self._buffer.close()
        self._thread.join()

    def _arrived(self, arrival: Arrival) -> None:
        header = arrival.header
        self.gaps.follow(header.seq)
        if header.encoding is Encoding.JPEG:
            raw = arrival.as_came()
            if raw is not None:
                self._done(arrival, raw.tobytes(), "jpeg")
                return
        self._buffer.put(arrival)

    def _run(self) -> None:
        while not self._buffer.closed:
            arrival = self._buffer.wait()
            if arrival is not None:
                self._encode_one(arrival)
            del arrival  # else its memory stayed on loan while this waits for the next one

    def _encode_one(self, arrival: Arrival) -> None:
        try:
            raw = arrival.as_came()
            header = arrival.header
            if raw is not None and header.encoding is Encoding.MONO8:
                image = raw.reshape(header.height, header.width)
            elif raw is not None and header.encoding is not Encoding.JPEG:
                image = to_bgr(header, raw)
            else:
                image = arrival.frame().image
            self._done(arrival, self._encode(header, image), self._format)
        except SkyloopError:
            self._failed += 1

    def _done(self, arrival: Arrival, data: bytes, format_: str) -> None:
        record = FrameRecord(arrival.header, arrival.received_ns, format_)
        self._put(self.channel, Rank.FRAME, Picture(record, data), len(data) + _SIZE, arrival.received_ns)


def encoder(options: Options) -> Encode:
    """Makes files of pictures, shape (height, width, 3) BGR or (height, width), uint8."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("recording raw frames", "record", cause=str(error)) from None
    if options.encoding == "png":  # level 1: twice as fast as the default and hardly larger
        suffix, settings = ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]
    else:
        suffix, settings = ".jpg", [cv2.IMWRITE_JPEG_QUALITY, options.quality]

    def encode(header: FrameHeader, image: NDArray[np.uint8]) -> bytes:
        try:
            done, data = cv2.imencode(suffix, image, settings)
        except cv2.error as error:
            raise SkyloopError(f"frame {header.seq} of {header.camera} can't be encoded: {error}") from None
        if not done:
            raise SkyloopError(f"frame {header.seq} of {header.camera} can't be encoded")
        return bytes(data)

    return encode


class Parameters:
    """All parameters at the start, then each that has changed, asked for on a thread of its own."""

    def __init__(self, drone: Drone, put: Callable[[Parameter], None]) -> None:
        self._drone = drone
        self._put = put
        self._known: dict[str, Parameter] = {}
        self._wake = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="skyloop-record-parameters", daemon=True)

    def start(self) -> None:
        self._wake.set()
        self._thread.start()

    def stop(self) -> None:
        self._ended = True
        self._wake.set()
        self._thread.join()

    def event(self, event: Event) -> None:
        """Look again when one was written, and when the link came back."""
        came_back = event.kind is EventKind.APPLICATION_LINK and event.data.get("state") == LinkState.UP
        if event.kind is EventKind.PARAMETER_CHANGED or came_back or event.kind is EventKind.VEHICLE_LINK:
            self._wake.set()

    def _run(self) -> None:
        again: float | None = None
        while True:
            self._wake.wait(again)
            if self._ended:
                return
            self._wake.clear()
            again = None if self._look() else _PARAMETERS_S

    def _look(self) -> bool:
        """Whether they could be asked for."""
        try:
            parameters = self._drone.config.parameters()
        except SkyloopError:
            return False
        for parameter in parameters:
            if self._known.get(parameter.name) != parameter:
                self._known[parameter.name] = parameter
                self._put(parameter)
        return True
