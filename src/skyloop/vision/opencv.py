"""OpenCV, imported when it is used, and what it calls its dictionaries of markers."""

from __future__ import annotations

from typing import Any

from skyloop.errors import MissingExtraError, UnknownNameError


def opencv(what: str) -> Any:
    """The module. Raises :class:`MissingExtraError` that says what is not possible without it."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(what, "vision", cause=str(error)) from error
    return cv2


def marker_dictionary(cv: Any, dictionary: str) -> Any:
    """By OpenCV's name, with or without ``DICT_``. Raises :class:`UnknownNameError`."""
    known = {name[5:].lower(): name for name in dir(cv.aruco) if name.startswith("DICT_")}
    name = known.get(dictionary.lower().removeprefix("dict_"))
    if name is None:
        raise UnknownNameError("marker dictionary", dictionary, known)
    return cv.aruco.getPredefinedDictionary(getattr(cv.aruco, name))
