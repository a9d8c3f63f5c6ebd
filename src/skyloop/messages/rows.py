"""Represent a drone's state and set-points as rows of numbers, for training data and learned policies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages.command import Attitude, Velocity
from skyloop.messages.feedback import Feedback

_VELOCITY: Final = ("velocity_forward_m_s", "velocity_left_m_s", "velocity_up_m_s")
#: Names of the numbers in a drone's own state; axes and units are those of :class:`Feedback`.
STATE: Final = ("roll_rad", "pitch_rad", "yaw_rad", "altitude_m", *_VELOCITY)
#: Names of the numbers in a set-point, by kind of set-point.
ACTIONS: Final[dict[str, tuple[str, ...]]] = {
    "velocity": ("forward", "left", "up", "yaw_rate"),
    "attitude": ("roll", "pitch", "climb", "yaw_rate"),
}


def state_row(feedback: Feedback, names: Sequence[str]) -> list[float] | None:
    """Return the named numbers (from :data:`STATE`) of a drone's state; None if any of them is unknown.

    Raises :class:`UnknownNameError` if a name is not in :data:`STATE`.
    """
    row = []
    for name in names:
        if name not in STATE:
            raise UnknownNameError("number of a drone's state", name, STATE)
        if name in _VELOCITY:
            velocity = feedback.velocity_m_s
            number = None if velocity is None else velocity[_VELOCITY.index(name)]
        else:
            number = getattr(feedback, name)
        if number is None:
            return None
        row.append(number)
    return row


def set_point(kind: str, row: Sequence[float]) -> Velocity | Attitude:
    """Return a set-point of a kind in :data:`ACTIONS`, built from its numbers in the order given there.

    Raises :class:`UsageError` if the row has the wrong length.
    """
    names = ACTIONS[kind]
    if len(row) != len(names):
        raise UsageError(f"a set-point of {kind} has {len(names)} numbers ({', '.join(names)}), not {len(row)}")
    numbers = [float(number) for number in row]
    return Velocity(*numbers) if kind == "velocity" else Attitude(*numbers)
