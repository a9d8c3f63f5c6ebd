"""OpenCV (imported on first use) and its marker dictionaries."""

from __future__ import annotations

from typing import Any

from skyloop.errors import MissingExtraError, UnknownNameError


def opencv(what: str) -> Any:
    """Import OpenCV; ``what``, a noun phrase for the error message, names the feature that needs it."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(what, "vision", cause=str(error)) from error
    return cv2


def marker_dictionary(cv: Any, dictionary: str) -> Any:
    """Return one of OpenCV's predefined dictionaries by its name, with or without ``DICT_``, in upper or lower case."""
    known = {name[5:].lower(): name for name in dir(cv.aruco) if name.startswith("DICT_")}
    name = known.get(dictionary.lower().removeprefix("dict_"))
    if name is None:
        raise UnknownNameError("marker dictionary", dictionary, known)
    return cv.aruco.getPredefinedDictionary(getattr(cv.aruco, name))
