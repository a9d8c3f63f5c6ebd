"""What applications send to others: annotations and logs to subscribers, poses from motion capture to the driver."""

from __future__ import annotations

from typing import Final

from skyloop.drivers.base import Driver, ExternalPose
from skyloop.errors import UnsupportedError, UsageError
from skyloop.messages import Annotation, EventKind, Refusal, Role, VehiclePose
from skyloop.proxy.events import Counters, EventDraft, EventPublisher
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.proxy.sessions import Session
from skyloop.proxy.topics import camera_problem
from skyloop.transport.base import ANNOTATIONS, LOGS, TransportServer

MAX_ANNOTATION: Final = 32_768  #: bytes of an annotation's packet


class Relay:
    """Passes on annotations, log entries and poses, on the receiving thread. The authority is not needed."""

    def __init__(
        self,
        driver: Driver,
        server: TransportServer,
        publisher: VehiclePublisher,
        events: EventPublisher,
        counters: Counters,
    ) -> None:
        self._driver = driver
        self._server = server
        self._cameras = publisher.cameras
        self._events = events
        self._counts = counters.counts

    def annotation(self, session: Session, annotation: Annotation, packet: bytes) -> str:
        """Pass an annotation on to its subscribers; returns why it is malformed, empty if it is not."""
        unknown = camera_problem(annotation.camera, self._cameras)
        if unknown:
            return f"an annotation of no known frame: {unknown}"
        if len(packet) > MAX_ANNOTATION:
            return f"an annotation has {len(packet)} bytes, at most {MAX_ANNOTATION} are relayed"
        return self._publish(session, ANNOTATIONS, packet)

    def log(self, session: Session, packet: bytes) -> str:
        """Pass a log entry on to its subscribers; returns why it is malformed, empty if it is not."""
        return self._publish(session, LOGS, packet)

    def _publish(self, session: Session, topic: str, packet: bytes) -> str:
        if session.role is None:
            return f"a packet for {topic} came before Hello"
        self._counts[f"{topic}.relayed"] += 1
        self._server.publish(topic, packet)
        return ""

    def pose(self, session: Session, pose: VehiclePose) -> None:
        """Pass a pose of the vehicle on to its driver. Refusals are published once a second at most."""
        if session.role is not Role.PILOT:
            self._refuse_pose(session, Refusal.OBSERVER, "observers can't send poses: connect as a pilot")
            return
        try:
            self._driver.external_pose(
                ExternalPose(
                    pose.position_m, pose.quaternion, pose.captured_ns, pose.position_std_m, pose.attitude_std_rad
                )
            )
        except UsageError as error:
            self._refuse_pose(session, Refusal.NON_FINITE, str(error))
        except UnsupportedError as error:
            self._refuse_pose(session, Refusal.UNSUPPORTED, str(error))
        except Exception as error:  # noqa: BLE001  the driver's code may raise anything
            self._refuse_pose(session, Refusal.DRIVER_FAILED, f"the driver failed: {error}")
        else:
            self._counts["poses.told"] += 1

    def _refuse_pose(self, session: Session, reason: Refusal, why: str) -> None:
        self._counts["poses.refused"] += 1
        self._events.publish_repeated(
            (session.app_id, "pose", reason),
            lambda: EventDraft(
                EventKind.COMMAND_REFUSED,
                f"{session.name}: a pose refused: {why}",
                app=session.name,
                data={"reason": reason.value, "app_id": session.app_id},
            ),
        )
