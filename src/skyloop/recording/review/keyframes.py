"""Key frames of a flight: those at its events, and others in between."""

from __future__ import annotations

import base64
from html import escape
from typing import Any, Final

import numpy as np

from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.messages.encoded import H264
from skyloop.recording.pictures import Picture
from skyloop.recording.reader import Recording
from skyloop.recording.review.tables import Table

WIDTH: Final = 360  #: of a thumbnail [px]
_QUALITY: Final = 80
_TELLING: Final = ("state_changed", "collision", "failsafe", "emergency", "authority_preempted")
_NEAR: Final = 0.4  #: share of the usual distance: an even frame is left out if one at an event is nearer than this


def moments(first_s: float, last_s: float, events: Table | None, most: int) -> list[tuple[float, str]]:
    """Select times to show, in order, each with the reason: up to half at events, the others evenly. Pure.

    Args:
        first_s: Time of the first frame.
        last_s: Time of the last frame.
        events: Of the flight; None without any.
        most: How many.
    """
    if most < 1 or last_s < first_s:
        return []
    chosen: list[tuple[float, str]] = []
    if events is not None:
        rows = zip(events.numbers("t_s"), events["kind"], events["severity"], events["text"], strict=True)
        candidates = [
            (float(t), str(text))
            for t, kind, severity, text in rows
            if first_s <= t <= last_s and (kind in _TELLING or severity != "info")
        ]
        step = max(1, -(-len(candidates) // max(1, most // 2)))
        chosen = candidates[::step]
    even = np.linspace(first_s, last_s, most)
    distance = (last_s - first_s) / max(1, most - 1)
    for t in even:
        if len(chosen) < most and all(abs(t - other) > _NEAR * distance for other, _ in chosen):
            chosen.append((float(t), ""))
    return sorted(chosen)


def figures(recording: Recording, drone: str, camera: str, frames: Table, events: Table | None, most: int) -> list[str]:
    """Return thumbnails as HTML, each of the first frame from its moment on."""
    t_s, seq = frames.numbers("t_s"), frames["seq"]
    wanted: dict[int, tuple[float, str]] = {}
    for moment, why in moments(float(t_s[0]), float(t_s[-1]), events, most):
        index = min(int(np.searchsorted(t_s, moment - 1e-9)), len(t_s) - 1)
        wanted.setdefault(int(seq[index]), (float(t_s[index]), why))
    shown = []
    for picture in recording.pictures(drone, camera):
        found = wanted.pop(picture.header.seq, None)
        if found is not None:
            shown.append(_figure(picture, *found))
        if not wanted:
            break
    return [figure for figure in shown if figure]


def _figure(picture: Picture, t_s: float, why: str) -> str:
    data, form = thumbnail(picture)
    if not data:
        return ""
    source = f"data:image/{form};base64,{base64.b64encode(data).decode()}"
    text = escape(why) or f"frame {picture.header.seq}"
    caption = f"<figcaption><b>{t_s:.1f} s</b> {text}</figcaption>"
    return f'<figure><img src="{source}" alt="frame at {t_s:.1f} s">{caption}</figure>'


def thumbnail(picture: Picture) -> tuple[bytes, str]:
    """Return a small image and its format.

    It is as recorded where it can't be scaled here, and empty if it is damaged, or H.264 that can't be decoded here.
    """
    try:
        image = picture.pixels()
    except MissingExtraError:
        return (b"", "") if picture.record.format == H264 else (picture.compressed, picture.record.format)
    except FileFormatError:
        return b"", ""
    import cv2

    height, width = image.shape[:2]
    shown: Any = image
    if width > WIDTH:
        shown = cv2.resize(image, (WIDTH, round(height * WIDTH / width)), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return (bytes(data), "jpeg") if done else (b"", "")
