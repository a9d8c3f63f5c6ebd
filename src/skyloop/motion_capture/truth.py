"""The simulator as a motion capture system: the true poses that its drones report with ``sim://?truth=1``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

from skyloop.errors import UnsupportedError
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.motion_capture.worker import RawFrame

if TYPE_CHECKING:
    from collections.abc import Iterable

    from skyloop.client import Drone
    from skyloop.messages import Feedback


class TruthSource:
    """Observes the proxies of simulated drones, and reads the true poses from their native telemetry."""

    def __init__(self, proxies: Iterable[str], take: Callable[[RawFrame], None]) -> None:
        """Initialise without connecting.

        Args:
            proxies: Names of the drones' proxies.
            take: Called with each frame, on the thread that receives feedback.
        """
        self._proxies = tuple(proxies)
        self._take = take
        self._open = ExitStack()

    def start(self, timeout_s: float) -> None:
        """Connect to all proxies.

        Args:
            timeout_s: How long to wait for each.

        Raises:
            UnsupportedError: A vehicle does not report its true pose.
            SkyloopError: As of :func:`skyloop.connect`.
        """
        from skyloop.client import connect

        with ExitStack() as opening:
            for name in self._proxies:
                drone = opening.enter_context(
                    connect(name, access="observe", name="skyloop mocap", timeout_s=timeout_s)
                )
                if true_pose(drone.feedback()) is None:
                    raise UnsupportedError(f"{name} reports no true pose: start it with truth=1, as sim://?truth=1")
                opening.enter_context(drone.on_feedback(self._taking(name, drone), inline=True))
            self._open = opening.pop_all()

    def close(self) -> None:
        """Disconnect from all. Idempotent."""
        self._open.close()

    def _taking(self, name: str, drone: Drone) -> Callable[[Feedback], None]:
        def take(feedback: Feedback) -> None:
            pose = true_pose(feedback)
            if pose is not None:
                self._take(RawFrame(feedback.captured_ns - drone.clock_offset_ns, {name: pose}))

        return take


def true_pose(
    feedback: Feedback,
) -> tuple[tuple[float, float, float], tuple[float, float, float, float]] | None:
    """Return position [m] and quaternion (x, y, z, w) from the simulator's native telemetry; None without them."""
    native = feedback.native or {}
    try:
        x, y, z, roll, pitch, yaw = (
            float(native[f"truth.{name}"])  # type: ignore[arg-type]
            for name in ("x", "y", "z", "roll", "pitch", "yaw")
        )
    except (KeyError, TypeError, ValueError):
        return None
    return (x, y, z), quaternion_from_euler(roll, pitch, yaw)
