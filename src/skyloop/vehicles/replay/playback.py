"""A replay's position, speed and pause, which viewers set through parameters and the player follows."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Final

from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value

POSITION: Final = "replay.position_s"
SPEED: Final = "replay.speed"
PAUSED: Final = "replay.paused"
SPEEDS: Final = (0.01, 1000.0)  #: slowest and fastest, in recorded seconds per second
NAMES: Final = frozenset({POSITION, SPEED, PAUSED})

_IN_STEP: Final = (
    "with speed=max the replay is in step with its application, which must not miss anything: give a number, such as "
    "speed=1, to pause it, move it or slow it down"
)


@dataclass(frozen=True, slots=True)
class Wanted:
    """The player's next task."""

    paused: bool
    speed: float
    position_s: float | None = None  #: where to seek to; None to continue from the present position


class Playback:
    """A replay's position, speed and pause. Thread-safe.

    With ``in_step`` (``speed=max``) its application advances it, and no parameter can be written.
    """

    def __init__(self, duration_s: float, speed: float = 1.0, *, in_step: bool = False) -> None:
        self.duration_s = duration_s
        self.position_s = 0.0  #: position in the recording, set by the player
        self.over = False  #: whether the end has been reached, set by the player
        self.jumps = 0  #: number of changes in position other than by playing, set by the player
        self.stopped = False
        self._default_speed = speed
        self._in_step = in_step
        self._lock = threading.Lock()
        self._wanted = Wanted(False, speed)
        self._changed = threading.Event()

    @property
    def paused(self) -> bool:
        """Whether the replay should be paused."""
        return self._wanted.paused

    @property
    def speed(self) -> float:
        """Recorded seconds per second."""
        return self._wanted.speed

    # Viewers ---------------------------------------------------------------------------------------------------

    def parameters(self) -> list[Parameter]:
        """Return the parameters with their current values."""
        with self._lock:
            wanted = self._wanted
        position_s = self.position_s if wanted.position_s is None else wanted.position_s
        return [
            Parameter(PAUSED, ParameterType.BOOL, wanted.paused, default=False, description="pauses the replay"),
            Parameter(
                POSITION,
                ParameterType.FLOAT,
                min(position_s, self.duration_s),
                "s",
                0.0,
                self.duration_s,
                description="position in the recording; write it to seek",
                momentary=True,
            ),
            Parameter(
                SPEED,
                ParameterType.FLOAT,
                wanted.speed,
                "",
                *SPEEDS,
                self._default_speed,
                description="recorded seconds per second",
            ),
        ]

    def set(self, name: str, value: Value) -> Value:
        """Write a parameter, which takes effect at once; return the value in force.

        Resuming at the end starts the replay over.
        """
        if name not in NAMES:
            raise UnknownNameError("parameter of a replay", name, NAMES)
        if self._in_step:
            raise ParameterError(f"{name} can't be written: {_IN_STEP}", code=Refusal.READ_ONLY)
        if name == PAUSED:
            if not isinstance(value, bool):
                raise ParameterError(f"{name} is true or false, not {value!r}", code=Refusal.WRONG_TYPE)
            at_end = (self.over or self.position_s >= self.duration_s) and self._wanted.position_s is None
            self._want(paused=value, position_s=0.0 if at_end and not value else None)
            return value
        low, high = (0.0, self.duration_s) if name == POSITION else SPEEDS
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise ParameterError(f"{name} is from {low:g} to {high:g}, not {value!r}", code=Refusal.OUT_OF_RANGE)
        if name == POSITION:
            self._want(position_s=float(value))
        else:
            self._want(speed=float(value))
        return float(value)

    def stop(self) -> None:
        """End the player."""
        self.stopped = True
        self._changed.set()

    # The player ------------------------------------------------------------------------------------------------

    @property
    def changed(self) -> bool:
        """Whether a parameter has been written since :meth:`take`, or the player should end."""
        return self._changed.is_set()

    def wait(self, timeout_s: float | None) -> None:
        """Wait for this long [s], or until a parameter is written."""
        self._changed.wait(timeout_s)

    def take(self) -> Wanted:
        """Return what the player should do now; each position is returned only once."""
        with self._lock:
            wanted, self._wanted = self._wanted, Wanted(self._wanted.paused, self._wanted.speed)
            if wanted.position_s is not None:  # the writer may read it back before that moment is shown
                self.position_s = wanted.position_s
            if not self.stopped:
                self._changed.clear()
        return wanted

    def _want(self, *, paused: bool | None = None, speed: float | None = None, position_s: float | None = None) -> None:
        with self._lock:
            now = self._wanted
            self._wanted = Wanted(
                now.paused if paused is None else paused,
                now.speed if speed is None else speed,
                now.position_s if position_s is None else position_s,
            )
            self._changed.set()
