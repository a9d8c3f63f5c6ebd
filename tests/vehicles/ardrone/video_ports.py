"""Stand-ins for the drone's video port, and a viewer of the pictures."""

from __future__ import annotations

import functools
import hashlib
import socket
import threading
from collections.abc import Callable
from contextlib import suppress

import av

from skyloop.clock import ManualClock
from skyloop.drivers.live_video import LiveFrame, VideoEvent
from skyloop.vehicles.ardrone.video import VideoReceiver
from skyloop.vehicles.ardrone.wire.pave import PaveFrame, PaveParser
from tests.support.recordings import recorded

HOST = "127.0.0.1"
LONG, SHORT = "video-8s.pave", "video-64-byte-headers.pave"
PATIENCE_S = 40.0

Digest = bytes


@functools.cache
def recording(name: str) -> bytes:
    return recorded(f"ardrone2/{name}").read_bytes()


@functools.cache
def pieces(name: str) -> tuple[bytes, ...]:
    """Return the recording's frames with their headers."""
    data = recording(name)
    starts = [0]
    while (start := data.find(b"PaVE", starts[-1] + 1)) > 0:
        starts.append(start)
    return tuple(data[a:b] for a, b in zip(starts, [*starts[1:], len(data)], strict=True))


@functools.cache
def frames(name: str) -> tuple[PaveFrame, ...]:
    return tuple(PaveParser().feed(recording(name)))


@functools.cache
def true_pictures(name: str) -> dict[int, Digest]:
    """Return a plain decoder's pictures of the undamaged recording from its first key frame on, by number."""
    context = av.CodecContext.create("h264", "r")
    context.flags |= av.codec.context.Flags.low_delay
    context.thread_count = 1
    all_frames = frames(name)
    first = next(n for n, frame in enumerate(all_frames) if frame.is_key)
    pictures = {}
    for frame in all_frames[first:]:
        (image,) = context.decode(av.Packet(frame.payload))
        pictures[frame.number] = digest(image.to_ndarray(format="bgr24").tobytes())
    return pictures


def digest(data: bytes) -> Digest:
    return hashlib.blake2b(data, digest_size=16).digest()


class Viewer:
    """Displays pictures unless configured otherwise, and records them."""

    def __init__(self) -> None:
        self.looks = True
        self.seen: list[tuple[int, int, Digest]] = []  # number, capture time, content
        self.sizes: set[tuple[int, int]] = set()
        self.notices: list[tuple[VideoEvent, str]] = []
        self.gate = threading.Event()  #: showing a picture takes until this is set
        self.gate.set()
        self._news = threading.Condition()

    @property
    def numbers(self) -> list[int]:
        return [number for number, _, _ in self.seen]

    def show(self, picture: LiveFrame) -> None:
        with self._news:
            assert picture.pixels.flags.c_contiguous
            self.seen.append((picture.number, picture.captured_ns, digest(picture.pixels.tobytes())))
            self.sizes.add((picture.width, picture.height))
            self._news.notify_all()
        self.gate.wait(10.0)

    def on_event(self, notice: VideoEvent, text: str) -> None:
        with self._news:
            self.notices.append((notice, text))
            self._news.notify_all()

    def wait(self, condition: Callable[[], object], what: str) -> None:
        with self._news:
            assert self._news.wait_for(lambda: bool(condition()), PATIENCE_S), f"{what}: {self.notices} {self.numbers}"

    def texts(self, notice: VideoEvent) -> list[str]:
        return [text for kind, text in self.notices if kind is notice]


def receiver_of(viewer: Viewer, port: int, version: int = 2, clock: ManualClock | None = None) -> VideoReceiver:
    """Return a receiver, by default with a stopped clock, so that no frame is ever late."""
    return VideoReceiver(
        HOST,
        port,
        version=version,
        show=viewer.show,
        on_event=viewer.on_event,
        wants=lambda: viewer.looks,
        clock=clock or ManualClock(),
    )


class TcpPort:
    """Listens, and plays one script per connection, in turn; the last one for all further connections."""

    def __init__(self, *scripts: Callable[[socket.socket], None], port: int = 0) -> None:
        self._scripts = scripts
        self._listener = socket.create_server((HOST, port))
        self.port: int = self._listener.getsockname()[1]
        self._ended = threading.Event()
        self._connection: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> TcpPort:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        for ended in (self._listener, self._connection):
            with suppress(OSError):
                if ended is not None:
                    ended.shutdown(socket.SHUT_RDWR)
        self._thread.join(PATIENCE_S)
        self._listener.close()
        assert not self._thread.is_alive()

    def _run(self) -> None:
        served = 0
        while not self._ended.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection:
                self._connection = connection
                script = self._scripts[min(served, len(self._scripts) - 1)]
                served += 1
                with suppress(OSError):
                    script(connection)
