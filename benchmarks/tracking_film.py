"""Load a recorded film as an array, with its hand-labelled boxes."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError
from skyloop.files import read_bytes, read_json
from skyloop.vehicles.ardrone.wire.pave import PaveParser
from skyloop.vision.tracking import Box

_MOST_BYTES = 200_000_000
LABELS = Path(__file__).parents[1] / "tests" / "data" / "tracking" / "ardrone2-desk.json"


class Labels(msgspec.Struct, frozen=True):
    """Boxes in a film."""

    film: str  #: path of the film within the recorded fixtures
    size: tuple[int, int]  #: width and height of a frame [px]
    how: str  #: how the boxes were made
    objects: dict[str, dict[int, Box]]  #: name → number of the frame → x, y, width, height [px]


def read_labels(path: Path = LABELS) -> Labels:
    """Read labelled boxes.

    Raises:
        UsageError: There is no such file.
        FileFormatError: The file has no labels.
    """
    return read_json(path, Labels, "labelled boxes of a film", _MOST_BYTES)


def read_film(path: Path, most: int | None = None) -> NDArray[np.uint8]:
    """Decode a film sent by an AR.Drone 2, (n, h, w, 3) BGR.

    Args:
        path: The PaVE stream.
        most: Number of frames, from the first; None for all.

    Raises:
        UsageError: There is no such file.
        FileFormatError: Nothing in the file can be decoded.
        MissingExtraError: PyAV is not installed.
    """
    from skyloop.vehicles.ardrone.pave_decoder import PaveDecoder

    decoder = PaveDecoder()
    frames = []
    for coded in PaveParser().feed(read_bytes(path, "a film", _MOST_BYTES))[:most]:
        image = decoder.decode(coded)
        if image is not None:
            frames.append(np.asarray(image.to_ndarray(format="bgr24"), np.uint8))
    if not frames:
        raise FileFormatError(f"{path} has no frame that can be decoded")
    return np.stack(frames)
