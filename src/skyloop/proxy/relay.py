"""Relay what applications send: annotations, logs and results to subscribers, and poses to the driver.

Results come from the workers of processors. :class:`WorkerRoster`, a pure class, assigns frames to the workers.
:class:`ProcessorWorkers` sends each worker its share and relays its results.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Final

import msgspec

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.base import Driver, ExternalPose
from skyloop.errors import UnsupportedError, UsageError
from skyloop.messages import (
    Annotation,
    AnyReply,
    Done,
    EventKind,
    JoinProcessor,
    ProcessorResult,
    ProcessorShare,
    Refusal,
    Refused,
    Role,
    Severity,
    Value,
    VehiclePose,
    encode,
)
from skyloop.proxy.events import Counters, EventDraft, EventPublisher
from skyloop.proxy.publisher import VehiclePublisher
from skyloop.proxy.requests import Session
from skyloop.proxy.topics import camera_problem
from skyloop.transport.base import ANNOTATIONS, LOGS, RESULTS, TransportServer, results

MAX_ANNOTATION: Final = 32_768  #: maximum number of bytes in an annotation's packet
#: A worker that is silent for this long loses its share, because the worker or its host hangs.
SILENT_S: Final = 1.0
#: How far in the future the capture time of a result's frame may be, because of errors in its camera's clock.
MAX_AHEAD_S: Final = 1.0
MAX_JOINED: Final = 8  #: maximum number of processors that one application may work for

_Key = tuple[int, str]  # number of the application, and name of the processor


class Relay:
    """Relays annotations, log entries and poses on the receiving thread. No authority is needed."""

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
        """Relay an annotation to its subscribers. Return why the annotation is malformed, or an empty string."""
        if unknown := camera_problem(annotation.camera, self._cameras):
            return f"an annotation of an unknown frame: {unknown}"
        if len(packet) > MAX_ANNOTATION:
            return f"an annotation has {len(packet)} bytes, at most {MAX_ANNOTATION} are relayed"
        return self._publish(session, ANNOTATIONS, packet)

    def log(self, session: Session, packet: bytes) -> str:
        """Relay a log entry to its subscribers. Return why the entry is malformed, or an empty string."""
        return self._publish(session, LOGS, packet)

    def _publish(self, session: Session, topic: str, packet: bytes) -> str:
        if session.role is None:
            return f"a packet for {topic} arrived before Hello"
        self._counts[f"{topic}.relayed"] += 1
        self._server.publish(topic, packet)
        return ""

    def pose(self, session: Session, pose: VehiclePose) -> None:
        """Pass the vehicle's pose to its driver. Refusals are published at most once a second."""
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
                f"{session.name}: pose refused: {why}",
                app=session.name,
                data={"reason": reason.value, "app_id": session.app_id},
            ),
        )


class ProcessorWorkers:
    """Sends workers their shares of the frames, and relays their results. Thread-safe."""

    def __init__(
        self,
        server: TransportServer,
        events: EventPublisher,
        counters: Counters,
        cameras: Callable[[], Collection[str]],
    ) -> None:
        """Initialise; ``cameras()`` returns the names of the vehicle's cameras."""
        self._cameras = cameras
        self._server = server
        self._events = events
        self._counts = counters.counts
        self._lock = threading.Lock()
        self._roster = WorkerRoster()
        self._sessions: dict[int, Session] = {}
        self._sent: dict[_Key, ProcessorShare] = {}

    def join(self, session: Session, asked: JoinProcessor, now_ns: int) -> AnyReply:
        """Make the application a worker, or renew its registration as one, and send it its share of the frames."""
        app_id = session.app_id
        with self._lock:
            before = self._roster.find(app_id, asked.processor)
            if (refused := self._refusal(session, asked, new=before is None)) is not None:
                return refused
            self._sessions[app_id] = session
            self._roster.register(app_id, asked, now_ns)
            self._sent.pop((app_id, asked.processor), None)  # sent each time, because the last one may have been lost
            self._send_shares()
        if before is None:
            self._publish_change(session, asked, "joined", f"works for processor {asked.processor}")
        elif asked.ready and not before.works:
            self._publish_change(session, asked, "back", f"works for processor {asked.processor} again")
        elif before.works and not asked.ready:
            text = f"gave up its share of processor {asked.processor}: busy for too long"
            self._publish_change(session, asked, "busy", text)
        return Done()

    def application_left(self, session: Session) -> None:
        """Remove an application whose connection has ended. The other workers get its share."""
        with self._lock:
            if self._sessions.pop(session.app_id, None) is None:
                return
            left = self._roster.remove(session.app_id)
            self._send_shares()
        for asked in left:
            self._publish_change(session, asked, "left", f"left processor {asked.processor}")

    def tick(self, now_ns: int) -> None:
        """Withdraw the shares of silent workers. Call several times a second."""
        with self._lock:
            silent = [(self._sessions[app_id], asked) for app_id, asked in self._roster.mark_silent(now_ns)]
            if silent:
                self._send_shares()
        for session, asked in silent:
            text = f"lost its share of processor {asked.processor}: silent for more than {SILENT_S:g} s"
            self._publish_change(session, asked, "silent", text)

    def relay(self, session: Session, result: ProcessorResult, now_ns: int) -> str:
        """Relay a result to its subscribers, marked with the number of the application that sent it.

        Returns why it is malformed, or an empty string. A refused result is counted, and published as an event.
        """
        if session.role is None:
            return "a result arrived before Hello"
        with self._lock:
            worker = self._roster.find(session.app_id, result.processor)
        why = ""
        if worker is None:
            why = f"it is not a worker of processor {result.processor}"
        elif result.camera != worker.asked.camera:
            why = f"it works for {result.processor} on frames of {worker.asked.camera}, not of {result.camera}"
        elif result.captured_ns - now_ns > nanoseconds(MAX_AHEAD_S):  # all later results would otherwise count as older
            why = f"its frame's capture time is {seconds(result.captured_ns - now_ns):.1f} s in the future"
        if why:
            self._counts["results.refused"] += 1
            text = f"a result of {session.name} was refused: {why}"
            data: dict[str, Value] = {"processor": result.processor, "state": "refused", "app_id": session.app_id}
            self._events.publish_repeated(
                (session.app_id, "results"), lambda: EventDraft(EventKind.PROCESSOR, text, app=session.name, data=data)
            )
            return ""
        packet = encode(msgspec.structs.replace(result, worker=session.app_id))
        self._counts["results.relayed"] += 1
        for topic in (RESULTS, results(result.processor)):
            self._server.publish(topic, packet)
        return ""

    # With the lock held ---------------------------------------------------------------------------------------------

    def _refusal(self, session: Session, asked: JoinProcessor, *, new: bool) -> Refused | None:
        if unknown := camera_problem(asked.camera, self._cameras):
            return Refused(Refusal.UNSUPPORTED, unknown)
        conflict = self._roster.conflict(session.app_id, asked)
        if conflict is not None:
            return Refused(Refusal.NAME_TAKEN, self._explain(asked, *conflict))
        if new and self._roster.joined(session.app_id) >= MAX_JOINED:
            return Refused(Refusal.BUSY, f"an application may work for at most {MAX_JOINED} processors")
        return None

    def _explain(self, asked: JoinProcessor, app_id: int, other: JoinProcessor) -> str:
        who = f"{self._sessions[app_id].name} (application {app_id})"
        if other.code != asked.code:
            why = f"runs other code under the name {asked.processor}: {other.code}, this one runs {asked.code}"
            return f"{who} {why}; use another name, or stop that application"
        ways = {True: "shares the frames", False: "takes all frames"}
        why = f"works for {asked.processor} and {ways[other.shared]}, while this one {ways[asked.shared]}"
        return f"{who} {why}: all its workers must do the same"

    def _send_shares(self) -> None:
        """Send each worker its share of the frames if the share has changed."""
        shares = self._roster.shares()
        self._sent = {key: share for key, share in self._sent.items() if key in shares}
        for key, share in shares.items():
            if self._sent.get(key) != share and self._server.send(self._sessions[key[0]].peer, encode(share)):
                self._sent[key] = share

    # With the lock free ---------------------------------------------------------------------------------------------

    def _publish_change(self, session: Session, asked: JoinProcessor, state: str, text: str) -> None:
        severity = Severity.INFO if state in ("joined", "back") else Severity.WARNING
        data: dict[str, Value] = {"processor": asked.processor, "state": state, "app_id": session.app_id}
        self._events.publish(EventKind.PROCESSOR, f"{session.name} {text}", severity, app=session.name, data=data)


@dataclass(slots=True)
class ProcessorWorker:
    """One application as a worker for one processor."""

    asked: JoinProcessor
    received_ns: int
    silent: bool = False

    @property
    def works(self) -> bool:
        return self.asked.ready and not self.silent


class WorkerRoster:
    """The workers of all processors, by application and processor name."""

    def __init__(self) -> None:
        self._workers: dict[_Key, ProcessorWorker] = {}

    def find(self, app_id: int, processor: str) -> ProcessorWorker | None:
        return self._workers.get((app_id, processor))

    def register(self, app_id: int, asked: JoinProcessor, now_ns: int) -> None:
        self._workers[app_id, asked.processor] = ProcessorWorker(asked, now_ns)

    def remove(self, app_id: int) -> list[JoinProcessor]:
        """Remove an application, and return the processors that it worked for."""
        keys = [key for key in self._workers if key[0] == app_id]
        return [self._workers.pop(key).asked for key in keys]

    def joined(self, app_id: int) -> int:
        return sum(app == app_id for app, _ in self._workers)

    def conflict(self, app_id: int, asked: JoinProcessor) -> tuple[int, JoinProcessor] | None:
        """Return another worker with that name that conflicts with this worker, if there is one."""
        for (app, name), worker in self._workers.items():
            other = worker.asked
            alike = (other.code, other.shared) == (asked.code, asked.shared)
            if name == asked.processor and app != app_id and not alike:
                return app, other
        return None

    def mark_silent(self, now_ns: int) -> list[tuple[int, JoinProcessor]]:
        """Mark workers that have been silent for too long; return those that were not marked before."""
        found = []
        for (app_id, _), worker in self._workers.items():
            if not worker.silent and now_ns - worker.received_ns > nanoseconds(SILENT_S):
                worker.silent = True
                found.append((app_id, worker.asked))
        return found

    def shares(self) -> dict[_Key, ProcessorShare]:
        """Return each worker's share of the frames."""
        groups: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
        for (app_id, name), worker in self._workers.items():
            groups[name, worker.asked.camera].append(app_id)
        found = {}
        for (name, camera), members in groups.items():
            working = sorted(app_id for app_id in members if self._workers[app_id, name].works)
            for app_id in members:
                part, parts = _part(app_id, working, shared=self._workers[app_id, name].asked.shared)
                found[app_id, name] = ProcessorShare(name, camera, part, parts, len(members))
        return found


def _part(app_id: int, working: list[int], *, shared: bool) -> tuple[int, int]:
    if app_id not in working:
        return 0, 0
    return (working.index(app_id), len(working)) if shared else (0, 1)
