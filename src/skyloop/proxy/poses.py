"""Poses from outside, from pilots' applications to the driver. What comes of them is told once a second at most."""

from __future__ import annotations

from skyloop.drivers.base import Driver
from skyloop.drivers.seams import ExternalPose
from skyloop.errors import UnsupportedError, UsageError
from skyloop.messages import EventKind, Refusal, Role, VehiclePose
from skyloop.proxy.events import EventLog, Notice
from skyloop.proxy.sessions import Session
from skyloop.proxy.statistics import Counters


class Poses:
    """Hands poses on. The authority is not needed: motion capture may be an application of its own."""

    def __init__(self, driver: Driver, events: EventLog, counters: Counters) -> None:
        self._driver = driver
        self._events = events
        self._counts = counters.counts

    def take(self, session: Session, pose: VehiclePose) -> None:
        """One pose of an application, on the receiving thread."""
        if session.role is not Role.PILOT:
            self._refuse(session, Refusal.OBSERVER, "observers tell a vehicle nothing: connect as a pilot")
            return
        x, y, z, w = pose.quaternion
        try:
            self._driver.external_pose(
                ExternalPose(pose.position, (w, x, y, z), pose.captured_ns, pose.position_std_m, pose.attitude_std_rad)
            )
        except UsageError as error:
            self._refuse(session, Refusal.NON_FINITE, str(error))
        except UnsupportedError as error:
            self._refuse(session, Refusal.UNSUPPORTED, str(error))
        except Exception as error:  # noqa: BLE001  the driver's code may raise anything
            self._refuse(session, Refusal.DRIVER_FAILED, f"the driver failed: {error}")
        else:
            self._counts["poses.told"] += 1

    def _refuse(self, session: Session, reason: Refusal, why: str) -> None:
        self._counts["poses.refused"] += 1
        self._events.repeated(
            (session.app_id, "pose", reason),
            lambda: Notice(
                EventKind.COMMAND_REFUSED,
                f"{session.name}: a pose refused: {why}",
                app=session.name,
                data={"reason": reason.value, "app_id": session.app_id},
            ),
        )
