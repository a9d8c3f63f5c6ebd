"""Images of ArUco and AprilTag markers, printed on a card with a white margin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UnknownNameError, UsageError
from skyloop.sim.render.opencv import cv2
from skyloop.sim.world import MARKER_DICTIONARIES, MarkerPattern

_CELL = 24  # texels a cell of the marker
_PAPER = 235


@dataclass(frozen=True, slots=True)
class Card:
    """An image of a marker.

    Attributes:
        image: BGR.
        uv: The part that the card shows: left, top, right, bottom in texels, with fractions.
    """

    image: NDArray[np.uint8]
    uv: tuple[float, float, float, float]


def draw_card(pattern: MarkerPattern) -> Card:
    """Draw a marker with its margin.

    The black square is ``pattern.size_m`` of the card's ``card_size_m`` to the texel's fraction.

    Raises:
        UnknownNameError: OpenCV has no such dictionary.
        UsageError: The dictionary has no such id.
    """
    code = getattr(cv2.aruco, pattern.dictionary, None) if pattern.dictionary.startswith("DICT_") else None
    if code is None:
        raise UnknownNameError("marker dictionary", pattern.dictionary, MARKER_DICTIONARIES)
    dictionary = cv2.aruco.getPredefinedDictionary(code)
    count = len(dictionary.bytesList)
    if not 0 <= pattern.marker_id < count:
        raise UsageError(f"{pattern.dictionary} has ids 0 to {count - 1}, so there is no marker {pattern.marker_id}")
    cells = dictionary.markerSize + 2
    black = cells * _CELL
    margin = pattern.margin_m / pattern.size_m * black
    border = int(np.ceil(margin)) + 2
    square = cv2.aruco.generateImageMarker(dictionary, pattern.marker_id, black, borderBits=1)
    ink = np.where(square > 127, _PAPER, 22).astype(np.uint8)
    image = cv2.copyMakeBorder(ink, border, border, border, border, cv2.BORDER_CONSTANT, value=_PAPER)
    start, end = border - margin, border + black + margin
    return Card(np.repeat(image[..., None], 3, axis=2).astype(np.uint8), (start, start, end, end))
