"""OpenCV, imported when it is used, and its dictionaries of markers."""

from __future__ import annotations

from typing import Any

from skyloop.errors import MissingExtraError, UnknownNameError


def opencv(what: str) -> Any:
    """Import OpenCV.

    Args:
        what: What needs it; a noun phrase for the error message.

    Returns:
        The module ``cv2``.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(what, "vision", cause=str(error)) from error
    return cv2


def marker_dictionary(cv: Any, dictionary: str) -> Any:
    """Return one of OpenCV's predefined dictionaries.

    Args:
        cv: The module ``cv2``.
        dictionary: Its name, with or without ``DICT_``, in any case.

    Raises:
        UnknownNameError: OpenCV has no such dictionary.
    """
    known = {name[5:].lower(): name for name in dir(cv.aruco) if name.startswith("DICT_")}
    name = known.get(dictionary.lower().removeprefix("dict_"))
    if name is None:
        raise UnknownNameError("marker dictionary", dictionary, known)
    return cv.aruco.getPredefinedDictionary(getattr(cv.aruco, name))
