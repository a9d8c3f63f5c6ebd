"""Judge the quality of arriving images in any contender's application. Needs only NumPy."""

from __future__ import annotations

from typing import Final

from benchmarks.measuring.contract import Image, Received
from benchmarks.measuring.schedule import MIDDLE
from benchmarks.moving_scene import MovingScene, psnr_db

SIZE: Final = MIDDLE  #: of the camera's pictures
JUDGED: Final = 10  #: one picture in this many is measured
QUALITY: Final = "quality "  #: prefix of the channels, one per decibel


class Judge:
    """Measures the quality of some of the pictures.

    Args:
        received: Called for each measurement.
    """

    def __init__(self, received: Received) -> None:
        self._received = received
        self._scene = MovingScene(SIZE)
        self._count = 0

    def look(self, image: Image, stamp_ns: int) -> None:
        """Judge a picture that has been counted as shown."""
        self._count += 1
        if self._count % JUDGED:
            return
        if image.shape[1] != SIZE.width:
            import cv2

            image = cv2.resize(image, (SIZE.width, SIZE.height), interpolation=cv2.INTER_LINEAR)  # type: ignore[assignment]
        self._received(f"{QUALITY}{psnr_db(image, self._scene.picture(stamp_ns)):.0f}", stamp_ns)
