"""A drone's video: the newest picture is encoded on a thread of its own, and given to the port."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import SkyloopError

_log = logging.getLogger(__name__)


class VideoSettings(Protocol):
    """Which cameras are to be sent."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """The camera that is shown, and then the one inset into its pictures, if any."""

    @property
    def inset(self) -> tuple[int, int]:
        """Width and height [px] of the inset picture."""


@dataclass(frozen=True, slots=True)
class OneCamera:
    """Pictures of one camera alone."""

    camera: str
    fps: float
    bitrate_kbps: int

    @property
    def cameras(self) -> tuple[str, ...]:
        """See :class:`VideoSettings`."""
        return (self.camera,)

    @property
    def inset(self) -> tuple[int, int]:
        """None: (0, 0)."""
        return 0, 0


S = TypeVar("S", bound=VideoSettings)
S_contra = TypeVar("S_contra", bound=VideoSettings, contravariant=True)


@dataclass(frozen=True, slots=True)
class Piece:
    """All that is sent of one picture, with its header."""

    data: bytes
    starts: bool  #: a decoder can begin here


@dataclass(frozen=True, slots=True)
class VideoStatus:
    """What was sent so far."""

    pictures: int = 0
    bytes_last: int = 0
    bitrate_kbps: int = 0


NOTHING_SENT: Final = VideoStatus()


class Packer(Protocol[S_contra]):
    """Encodes pictures, one after the other. Not thread-safe."""

    def pack(self, picture: NDArray[np.uint8], settings: S_contra, captured_ns: int, /) -> Piece | None: ...


class VideoEncoding(Generic[S]):
    """Encodes on a thread of its own. A picture that comes meanwhile waits, and is replaced by a newer one.

    Args:
        packer: Encodes; used on the thread.
        settings: Returns what is to be sent. Called on any thread.
        send: Called on the thread with each encoded picture.
    """

    def __init__(self, packer: Packer[S], settings: Callable[[], S], send: Callable[[Piece], None]) -> None:
        self._packer = packer
        self._settings = settings
        self._send = send
        self._changed = threading.Condition()
        self._newest: dict[str, tuple[NDArray[np.uint8], int]] = {}
        self._fresh = False
        self._stopping = False
        self._sent_ns = 0
        self._thread = threading.Thread(target=self._run, name="skyloop-firmware-video", daemon=True)
        self.status = NOTHING_SENT

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread and wait for it."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def wants(self, camera: str) -> bool:
        """Return whether this camera is to be sent."""
        return camera in self._settings().cameras

    def show(self, camera: str, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """Hand over a picture. Returns at once.

        Args:
            camera: Its name.
            pixels: BGR, uint8, shape (height, width, 3); must not change any more.
            captured_ns: When it was captured.
        """
        shown = self._settings().cameras
        if camera not in shown:
            return
        with self._changed:
            self._newest[camera] = pixels, captured_ns
            if camera == shown[0]:
                self._fresh = True
                self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._fresh or self._stopping)
                if self._stopping:
                    return
                self._fresh = False
                newest = dict(self._newest)
            try:
                self._encode(newest)
            except (SkyloopError, ValueError, OSError):
                _log.exception("a picture could not be encoded")

    def _encode(self, newest: dict[str, tuple[NDArray[np.uint8], int]]) -> None:
        settings = self._settings()
        main, *others = settings.cameras
        if main not in newest:
            return
        picture, captured_ns = newest[main]
        if others and others[0] in newest:
            picture = with_inset(picture, newest[others[0]][0], settings.inset)
        piece = self._packer.pack(picture, settings, captured_ns)
        if piece is None:
            return
        size, since_ns = len(piece.data), captured_ns - self._sent_ns
        self._sent_ns = captured_ns
        rate = size * 8 * NS_PER_S // max(since_ns, 1) // 1000
        self.status = VideoStatus(self.status.pictures + 1, size, min(rate, 1_000_000))
        self._send(piece)


def with_inset(picture: NDArray[np.uint8], other: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a copy of a picture with another one, scaled down to (width, height), in its upper left corner."""
    width, height = size
    rows = np.arange(height) * other.shape[0] // height
    columns = np.arange(width) * other.shape[1] // width
    made = picture.copy()
    made[:height, :width] = other[rows[:, None], columns]
    return made
