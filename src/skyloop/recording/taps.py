"""Subscribe to drones in order to record or show them: samples go to a backlog, frames go through an encoder."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from skyloop.client import Drone, Result
from skyloop.client.channels import Listener, Mailbox
from skyloop.client.frame import ReceivedFrame, to_bgr
from skyloop.clock import beats, nanoseconds
from skyloop.errors import MissingExtraError, SkyloopError, UsageError
from skyloop.extend import Known, stream_channel, video_channel
from skyloop.messages import (
    Annotation,
    Applied,
    EncodedFrame,
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
from skyloop.messages.frame import H264, Chain
from skyloop.platform import lower_priority
from skyloop.recording.backlog import Backlog, Item, Rank
from skyloop.recording.layout import Channel, Drops, FrameRecord
from skyloop.recording.options import MB, VIDEO, Options
from skyloop.recording.translation import TranslatedImage

_FRAMES_WAITING: Final = 2  # frames besides the one being encoded and the one arriving; a client can't hold more slots
_SIZE: Final = 400  #: approximate size of a typical sample [bytes]
_STREAM_GONE_NS: Final = nanoseconds(2.0)  # after this time without a frame of the stream, decoded frames are recorded
_PARAMETERS_S: Final = 2.0  # pause before the next attempt to read parameters

_log = logging.getLogger(__name__)

Encode = Callable[[FrameHeader, "NDArray[np.uint8]"], bytes]


def check_names(drones: Sequence[Drone], of: str) -> None:
    """Check that the drones in a recording or view have distinct names.

    Raise ``UsageError`` if two drones have the same name.
    """
    names = [drone.name for drone in drones]
    if len(set(names)) < len(names):
        raise UsageError(f"the drones of a {of} must have different names, got {', '.join(names)}")


class Gaps:
    """Counts the numbers missing from an increasing sequence. A number that is not higher starts a new sequence."""

    def __init__(self) -> None:
        self.missed = 0
        self._last: int | None = None

    def restart(self) -> None:
        """Start a new sequence: any gap before the next number is intentional, not a loss."""
        self._last = None

    def follow(self, number: int) -> None:
        """Process the next number."""
        last = self._last
        if last is not None and number > last + 1:
            self.missed += number - last - 1
        self._last = number


class Tap:
    """Subscribes to one drone and adds its samples to the backlog."""

    def __init__(
        self, number: int, drone: Drone, options: Options, backlog: Backlog, *, encoded_far: bool = False
    ) -> None:
        """Initialise without subscribing. With ``encoded_far``, the proxy encodes raw frames as H.264 for a network."""
        self.drone = drone
        self._number = number
        self._options = options
        self._backlog = backlog
        self._listeners: list[Listener[Any]] = []
        self._gaps = {Channel.FEEDBACK.value: Gaps(), Channel.EVENTS.value: Gaps()}
        self._videos = [
            Video(self._put, drone, camera.name, options, encoded_far=encoded_far)
            for camera in drone.capabilities.cameras
            if options.wants_camera(camera.name)
        ]
        self._parameters = Parameters(drone, self.put_parameter) if options.wants(Channel.PARAMETERS) else None

    def start(self) -> None:
        drone, wants = self.drone, self._options.wants
        listen: tuple[tuple[Channel, Callable[..., Listener[Any]], Callable[[Any], None]], ...] = (
            (Channel.FEEDBACK, drone.on_feedback, self._feedback),
            (Channel.EVENTS, drone.on_event, self._event),
            (Channel.COMMANDS, drone.on_command, self._applied),
            (Channel.ANNOTATIONS, drone.on_annotation, self._annotation),
            (Channel.LOGS, drone.on_log, self._log),
            (Channel.RESULTS, drone.on_result, self._result),
        )
        for channel, subscribe, sink in listen:
            if wants(channel):
                self._listeners.append(subscribe(sink, inline=True))
        if self._parameters is not None:
            self._listeners.append(drone.on_event(self._parameters.on_event, inline=True))
            self._parameters.start()
        for video in self._videos:
            video.start()

    def stop(self) -> None:
        """Unsubscribe. Afterwards, the backlog holds all received samples except frames that were not yet encoded."""
        for listener in self._listeners:
            listener.cancel()
        if self._parameters is not None:
            self._parameters.stop()
        for video in self._videos:
            video.stop()

    def dropped(self) -> dict[str, int]:
        """Return the number of samples that were received but dropped, by channel."""
        found = {
            channel: count for (number, channel), count in list(self._backlog.dropped.items()) if number == self._number
        }
        for video in self._videos:
            if video.dropped:
                found[video.channel] = found.get(video.channel, 0) + video.dropped
        return found

    def missed(self) -> dict[str, int]:
        """Return the number of samples that were never received, by channel."""
        found = {channel: gap.missed for channel, gap in self._gaps.items()}
        found |= {video.channel: video.missed for video in self._videos}
        return {channel: missed for channel, missed in found.items() if missed}

    def check_streams(self) -> None:
        """Check whether the vehicle's own encoding is still arriving. Called every second."""
        for video in self._videos:
            video.check_stream(time.monotonic_ns())

    def put_drops(self, dropped: dict[str, int], missed: dict[str, int]) -> None:
        """Add the counts of dropped and missed samples to the backlog."""
        now_ns = time.monotonic_ns()
        self._put("drops", Rank.KEPT, Drops(now_ns, dropped, missed), _SIZE, now_ns)

    def put_event(self, text: str, severity: Severity, data: dict[str, str]) -> None:
        """Add one of the recorder's own events to the backlog."""
        event = Event(EventKind.RECORDING, text, self.drone.now_ns, severity, app="recorder", data=dict(data))
        self._put(Channel.EVENTS.value, Rank.KEPT, event, _SIZE)

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
        if event.seq:  # the client's own events have no number
            self._gaps["events"].follow(event.seq)
        if event.kind is not EventKind.RECORDING:  # put_event adds the recorder's own events itself
            self._put("events", Rank.KEPT, event, _SIZE)

    def _applied(self, applied: Applied) -> None:
        self._put("commands", Rank.KEPT, applied, _SIZE)

    def _annotation(self, annotation: Annotation) -> None:
        self._put("annotations", Rank.STATE, annotation, _SIZE + 100 * len(annotation.shapes))

    def _log(self, entry: LogEntry) -> None:
        self._put("logs", Rank.KEPT, entry, _SIZE + len(entry.text or "") + 10 * len(entry.values or ()))

    def _result(self, result: Result) -> None:
        self._put("results", Rank.STATE, result.header, _SIZE + len(result.header.payload))


class Stream:
    """One camera's H.264 as sent by the vehicle, or as the proxy encodes it for a subscriber, from a key frame on."""

    def __init__(self, put: Callable[..., None], drone: Drone, camera: str, subscriber: str = "") -> None:
        self.gaps = Gaps()
        self.dropped = 0  #: frames that can't be decoded because an earlier one is missing
        self.newest_ns = 0  #: arrival time of the newest decodable frame, or the time of the start
        self._put = put
        self._channel = f"{VIDEO}.{camera}"
        self._topic = stream_channel(drone, camera, subscriber=subscriber)
        self._chain = Chain()
        self._begun = False
        self._sink = self._arrived

    def start(self) -> None:
        self.newest_ns = time.monotonic_ns()
        self._topic.add(self._sink, lambda: 0)

    def stop(self) -> None:
        self._topic.remove(self._sink)

    def _arrived(self, picture: EncodedFrame) -> None:
        now_ns = time.monotonic_ns()
        self.gaps.follow(picture.seq)
        follows = picture.codec == H264 and self._chain.follows(picture.seq, key=picture.key)
        self._topic.report(picture.seq, wants_key=not follows)
        if not follows:
            self.dropped += self._begun
            return
        self._begun = True
        self.newest_ns = now_ns
        header = picture.decoded(picture.width, picture.height)
        record = FrameRecord(header, now_ns, H264, picture.key)
        size = len(picture.data) + _SIZE
        self._put(self._channel, Rank.FRAME, TranslatedImage(record, picture.data), size, now_ns)


class Video:
    """One camera's frames. They are encoded on a separate thread unless they arrive as JPEG.

    If the vehicle's encoding is kept, decoded frames are subscribed to only while its stream is not arriving.
    """

    def __init__(
        self, put: Callable[..., None], drone: Drone, camera: str, options: Options, *, encoded_far: bool = False
    ) -> None:
        self.channel = f"{VIDEO}.{camera}"
        self.gaps = Gaps()
        self._put = put
        self._topic = video_channel(drone, camera)
        self._encode = encoder(options)
        self._format = "png" if options.encoding == "png" else "jpeg"
        self._stream: Stream | None = None
        if options.keeps_stream(self._topic.camera):
            self._stream = Stream(put, drone, camera)
        elif encoded_far and (known := Known(drone)).is_far:
            self._stream = Stream(put, drone, camera, f"{known.subscriber}-view")
        self._lock = threading.Lock()  # guards the subscription to frames
        self._listening = self._ended = False
        self._failed = 0
        self._buffer: Mailbox[ReceivedFrame] = Mailbox(_FRAMES_WAITING)
        self._sink = self._arrived
        self._thread = threading.Thread(target=self._run, name=f"skyloop-record-{camera}", daemon=True)

    @property
    def dropped(self) -> int:
        """Number of frames that the encoder skipped or could not encode, or that can't be decoded."""
        return self._buffer.dropped + self._failed + (self._stream.dropped if self._stream is not None else 0)

    @property
    def missed(self) -> int:
        """Number of frames that never arrived."""
        return self.gaps.missed + (self._stream.gaps.missed if self._stream is not None else 0)

    def start(self) -> None:
        """Start the encoder's thread and subscribe."""
        self._thread.start()
        if self._stream is not None:
            self._stream.start()
        else:
            self._listen(True)

    def stop(self) -> None:
        """Unsubscribe and end the encoder's thread."""
        if self._stream is not None:
            self._stream.stop()
        self._listen(False)
        with self._lock:
            self._ended = True
        self._buffer.close()
        if self._thread.ident is not None:  # start() may have failed before starting the thread
            self._thread.join()

    def check_stream(self, now_ns: int) -> None:
        """Subscribe to frames while the vehicle's stream is not arriving (it may differ from what was announced)."""
        if self._stream is not None:
            self._listen(now_ns - self._stream.newest_ns > _STREAM_GONE_NS)

    def _listen(self, on: bool) -> None:
        with self._lock:
            if on == self._listening or self._ended:
                return
            self._listening = on
            if on:
                self.gaps.restart()
                self._topic.add(self._sink, lambda: 0)
            else:
                self._topic.remove(self._sink)

    def _arrived(self, arrival: ReceivedFrame) -> None:
        if self._stream is not None and arrival.received_ns - self._stream.newest_ns < _STREAM_GONE_NS:
            return  # the stream has returned and is recorded instead
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
            del arrival  # otherwise its frame slot would remain leased during the wait for the next frame

    def _encode_one(self, arrival: ReceivedFrame) -> None:
        try:
            raw = arrival.as_came()
            header = arrival.header
            if raw is not None and header.encoding is Encoding.MONO8:
                image = raw.reshape(header.height, header.width)
            elif raw is not None and header.encoding is not Encoding.JPEG:
                image = to_bgr(header, raw)
            else:
                image = np.asarray(arrival.frame())
            self._done(arrival, self._encode(header, image), self._format)
        except Exception as error:  # noqa: BLE001  (one frame is lost; if the thread ended, all would be)
            self._failed += 1
            if not isinstance(error, SkyloopError):
                _log.exception("frame %s of %s can't be recorded", arrival.header.seq, arrival.header.camera)

    def _done(self, arrival: ReceivedFrame, data: bytes, format_: str) -> None:
        record = FrameRecord(arrival.header, arrival.received_ns, format_)
        self._put(self.channel, Rank.FRAME, TranslatedImage(record, data), len(data) + _SIZE, arrival.received_ns)


def encoder(options: Options) -> Encode:
    """Return a function that encodes images of shape (height, width, 3), BGR, or (height, width); uint8."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("recording raw frames", "record", cause=str(error)) from None
    if options.encoding == "png":  # level 1 is twice as fast as the default level and makes files hardly larger
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
    """Passes all parameters to ``put`` at the start, then each change, on a separate thread."""

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
        if self._thread.ident is not None:  # start() may have failed before starting the thread
            self._thread.join()

    def on_event(self, event: Event) -> None:
        """Read the parameters again after one of them or the vehicle's link changed, or our own link was restored."""
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
            again = None if self._read_all() else _PARAMETERS_S

    def _read_all(self) -> bool:
        """Read the parameters; return whether this succeeded."""
        try:
            parameters = self._drone.config.parameters()
        except Exception as error:  # noqa: BLE001 (retried later; if the thread ended, no changes would be recorded)
            if not isinstance(error, SkyloopError):
                _log.exception("the parameters of %s can't be recorded", self._drone.name)
            return False
        for parameter in parameters:
            if self._known.get(parameter.name) != parameter:
                self._known[parameter.name] = parameter
                self._put(parameter)
        return True


# A live view -----------------------------------------------------------------------------------------------------


BEAT_S: Final = 0.02  #: interval between polls of the backlog, so that receiving threads need not wake the view
_BATCH: Final = MB  # number of bytes to show before the screen is asked again which sources it needs
_LIMIT: Final = 16 * MB  # maximum number of bytes held for a slow screen; older images are useless to a viewer
_RESERVE: Final = 16 * MB  # additional bytes held for samples that must not be dropped
_QUALITY: Final = 80  # JPEG quality: these images are only viewed, not stored
_CHECK_NS: Final = nanoseconds(1.0)  # interval between checks of the video streams
NICENESS: Final = 5  #: niceness of processes that record or show drones

#: The index of a drone, and a channel named as in :data:`skyloop.recording.options.CHOICES`, or ``video.CAMERA``.
Source = tuple[int, str]


class Screen(Protocol):
    """Displays samples. All methods except :meth:`close` are called on the view's thread."""

    def wanted(self) -> frozenset[Source]:
        """Return the sources that are currently displayed; only these are subscribed to."""

    def show(self, item: Item) -> None: ...

    def close(self) -> None:
        """Close the screen. Called after the view's thread has ended."""


class View:
    """Shows drones on a screen from :meth:`start` to :meth:`close`. Use it as a context manager."""

    def __init__(self, drones: Sequence[Drone], screen: Screen) -> None:
        """Initialise without subscribing. The view closes the screen.

        Raise ``UsageError`` if two drones have the same name.
        """
        check_names(drones, "view")
        self.failed = 0  #: number of samples that could not be shown
        self.failed_why = ""  #: channel and error of the last sample that could not be shown
        self._drones = drones
        self._screen = screen
        self._backlog = Backlog(_LIMIT, _RESERVE)
        self._taps: dict[Source, Tap] = {}
        self._check_due_ns = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-view", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Unsubscribe and close the screen. Idempotent."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._screen.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def subscribed(self) -> dict[str, list[str]]:
        """Current subscriptions by drone. Safe to read from any thread."""
        found: dict[str, list[str]] = {}
        for number, channel in sorted(self._taps):
            found.setdefault(self._drones[number].name, []).append(channel)
        return found

    @property
    def dropped(self) -> int:
        """Samples dropped because the screen was too slow. Safe to read from any thread."""
        return sum(tuple(self._backlog.dropped.values()))

    # The thread ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        for _ in beats(BEAT_S, self._closing):
            self._try_step(ending=False)
        self._try_step(ending=True)

    def _try_step(self, *, ending: bool) -> None:
        try:
            self.step(time.monotonic_ns(), ending=ending)
        except Exception:  # noqa: BLE001  (a view that ended would show a frozen image of a flying drone)
            _log.exception("the view continues after an error")

    def step(self, now_ns: int, *, ending: bool = False) -> None:
        """Subscribe to the sources needed and show received samples. Called by the view's thread, or by a test."""
        self._subscribe(frozenset() if ending else self._screen.wanted())
        for item in self._backlog.take(_BATCH):
            try:
                self._screen.show(item)
            except Exception as error:  # noqa: BLE001 (samples contain whatever applications send)
                self.failed += 1
                self.failed_why = f"{item.channel}: {error!r:.200}"
                _log.warning("a sample of %s can't be shown: %r", item.channel, error)
        if now_ns >= self._check_due_ns:
            self._check_due_ns = now_ns + _CHECK_NS
            for tap in self._taps.values():
                tap.check_streams()

    def _subscribe(self, wanted: frozenset[Source]) -> None:
        for source in self._taps.keys() - wanted:
            self._taps.pop(source).stop()
        for source in sorted(wanted - self._taps.keys()):
            number, channel = source
            options = Options(channels=(channel,), quality=_QUALITY)
            tap = Tap(number, self._drones[number], options, self._backlog, encoded_far=True)
            self._taps[source] = tap
            tap.start()


def give_way() -> None:
    """Lower the priority of this process and of threads it starts later, so that flying takes precedence."""
    lower_priority(NICENESS)
