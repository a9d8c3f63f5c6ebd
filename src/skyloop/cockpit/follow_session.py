"""Follow a target that a person marked on a page: from the box to set-points and messages, on the event loop.

The content of a box is only tracked until the page sets a mode, either together with the box or later
(:meth:`FollowSession.fly`). In flight, each report from the :class:`~skyloop.cockpit.target_tracker.TargetTracker`
yields one set-point; after :data:`STOPPED_S` without a new frame, the vehicle hovers until frames arrive again.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.cockpit.feeds import call_soon, start_task
from skyloop.cockpit.place_flight import UP
from skyloop.cockpit.target_tracker import Follower, FrameKeeper, TargetTracker, TrackReport
from skyloop.cockpit.telemetry import number, vector
from skyloop.control.chase_law import ChaseSettings, FollowMode
from skyloop.control.target_follower import TargetFollower
from skyloop.errors import AuthorityError, LinkError, RefusedError, SkyloopError, UnknownNameError
from skyloop.messages import CameraInfo, Failsafe, Feedback, FrameHeader, Value
from skyloop.vision.opencv import opencv
from skyloop.vision.tracking import Box, checked_box

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.commands import SelectTarget, SetFollowMode, TrackTarget
    from skyloop.cockpit.station import PilotConnection
    from skyloop.messages import AnyAction

STOPPED_S: Final = 0.5  #: the vehicle hovers if no new frame arrives for this long
OLD_S: Final = 1.0  #: the vehicle also hovers if a frame is older than this when it is tracked
OLD_FEEDBACK_S: Final = 1.0  #: following ends if the feedback is older than this
#: Maximum age of a request that may start a flight: when it is older, the tracker is stuck or nobody expects a flight.
SET_OFF_S: Final = 10.0
WATCH_S: Final = 0.1  #: interval between checks whether the tracker still reports
NUMBERS_PERIOD_S: Final = 0.2  #: interval between messages that differ only in numbers
JOIN_S: Final = 2.0  #: time limit for a tracker's thread to end
NO_CONTROL: Final = "this page has lost control"
_WHAT: Final = "following a target"

Json = dict[str, Any]


class FollowerFactory(Protocol):
    """Creates a follower for one target, like :class:`skyloop.control.target_follower.TargetFollower`."""

    def __call__(
        self,
        camera: CameraInfo,
        *,
        box: Box,
        class_name: str | None,
        mode: FollowMode,
        settings: ChaseSettings,
    ) -> Follower: ...


class FollowSession:
    """Tracks one target at a time for a page and follows it. Used on the event loop.

    ``drone``: provides the frames; may be connected as an observer. ``clear``: ends the page's other flights; it is
    called before the first set-point. ``make``: creates followers; called on a worker thread.
    """

    def __init__(
        self,
        drone: Drone,
        send: Callable[[Json], None],
        clear: Callable[[], None],
        make: FollowerFactory = TargetFollower,
        clock: Clock = monotonic_ns,
    ) -> None:
        self._drone = drone
        self._send = send
        self._clear = clear
        self._make = make
        self._clock = clock
        self._keeper: FrameKeeper | None = None  # not None while a person draws a box
        self._tracker: TargetTracker | None = None
        self._camera = ""
        self._mode = ""
        self._distance_m = 0.0
        self._limits: dict[str, Value] = {}  # the drone's limits, read when the target was marked
        self._pilot: PilotConnection | None = None  # set while the vehicle is following or about to follow
        self._flying = False
        self._waits = ""  # reason why it is currently hovering
        self._action: AnyAction | None = None  # the last set-point
        self._report: TrackReport | None = None
        self._reported_ns = 0
        self._asked_ns = 0  # time at which the flight was requested
        self._last_sent: tuple[Any, ...] = ()
        self._last_sent_ns = 0
        self._watch: asyncio.TimerHandle | None = None
        self._ending: set[asyncio.Task[None]] = set()

    @property
    def is_under_way(self) -> bool:
        """Whether the session commands the vehicle, or is about to."""
        return self._pilot is not None

    # Requests from the page ------------------------------------------------------------------------------------

    async def select(self, command: SelectTarget) -> None:
        """Keep a camera's frames until a box arrives or the page cancels; raise ``UnknownNameError`` if unknown."""
        if self._keeper is not None:
            self._keeper.close()
            self._keeper = None
        if command.camera is None:
            return
        camera = self._camera_info(command.camera)
        await asyncio.to_thread(opencv, _WHAT)
        loop = asyncio.get_running_loop()
        self._keeper = FrameKeeper(
            self._drone, camera.name, lambda since_ns: call_soon(loop, self._selecting, camera.name, since_ns)
        )

    async def begin(self, command: TrackTarget, held: Callable[[], PilotConnection]) -> None:
        """Track the object inside a box; if a mode is given, follow it once the tracker has caught up.

        Args:
            command: The page's command.
            held: Returns the connection that holds authority; raises if there is none or a newer command has been
                given. Called only if a mode is given, first at the beginning and again before the flight.

        Raises:
            AuthorityError: A mode was given, but this page does not hold authority.
            RefusedError: The frame was not kept, the vehicle is not in the air, or a newer command has been given.
            UsageError: The box, mode, distance or camera is invalid.
            MissingExtraError: OpenCV is not installed.
        """
        camera = self._camera_info(command.camera)
        settings = _settings(command.distance_m)
        if command.mode is not None:
            _check_mode(command.mode)
            _check_in_air(held())
        await asyncio.to_thread(opencv, _WHAT)
        self._limits = await asyncio.to_thread(lambda: dict(self._drone.config.items()))
        keeper = self._keeper
        if keeper is None or keeper.camera != camera.name:
            raise RefusedError(f"no frames of {camera.name} were kept: select the camera first (follow_select)")
        first = keeper.find(int(command.captured_ns))
        box = checked_box(in_frame(command, first.header), (first.header.height, first.header.width))
        pilot = None if command.mode is None else held()
        self.end("another target was marked")
        self._keeper = None  # from now on, the tracker owns the frame keeper
        self._camera, self._mode, self._pilot = camera.name, command.mode or "", pilot
        self._distance_m = settings.distance_m
        settings = settings.within(self._limits)
        mode = FollowMode(command.mode or FollowMode.FOLLOW)
        make = partial(self._make, camera, box=box, class_name=command.class_name, mode=mode, settings=settings)
        loop = asyncio.get_running_loop()

        def report(made: TrackReport) -> None:
            call_soon(loop, self._on_report, tracker, made)

        self._report, self._reported_ns = None, self._clock()
        self._asked_ns = self._reported_ns
        tracker = self._tracker = TargetTracker(self._drone, keeper, first, make, report, self._clock)
        tracker.steers = pilot is not None
        tracker.start()
        self._send_state()

    def fly(self, command: SetFollowMode, pilot: PilotConnection) -> None:
        """Follow the tracked target, or change the mode of following.

        Raise ``RefusedError`` if nothing is tracked or the vehicle is not in the air, and ``UsageError`` if the mode or
        distance is invalid.
        """
        tracker = self._tracker
        if tracker is None:
            raise RefusedError("no target is tracked: mark one first")
        _check_mode(command.mode)
        if not self._flying:
            _check_in_air(pilot)
        if command.distance_m is not None:
            tracker.settings = _settings(command.distance_m).within(self._limits)
            self._distance_m = command.distance_m
        self._mode = tracker.mode = command.mode
        self._pilot, self._asked_ns = pilot, self._clock()  # flight starts with the first report after catching up
        tracker.steers = True
        self._send_state()

    def interrupt(self, why: str) -> None:
        """End following, because another command was given or control was lost; a merely tracked target is kept."""
        if self._pilot is not None:
            self.end(why, hover=False)

    def end(self, why: str = "", *, hover: bool = True) -> None:
        """Forget the target.

        ``why``: the reason shown on the page; empty if the person requested it. ``hover``: whether to hover if the
        vehicle was following; pass False if another command is given.
        """
        tracker, pilot, flying = self._tracker, self._pilot, self._flying
        if tracker is None:
            return
        tracker.close()
        start_task(asyncio.to_thread(tracker.join, JOIN_S), self._ending)
        self._tracker = self._pilot = self._action = None
        self._flying, self._waits = False, ""
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None
        if hover and flying and pilot is not None:
            pilot.let_go(why or "following was ended")
        self._send_state("ended", why)
        self._report = None

    async def close(self) -> None:
        """Forget the target and the frames, and wait for their threads to end."""
        self.end()
        if self._keeper is not None:
            self._keeper.close()
            self._keeper = None
        await asyncio.gather(*self._ending, return_exceptions=True)

    # While tracking --------------------------------------------------------------------------------------------

    def _on_report(self, tracker: TargetTracker, report: TrackReport) -> None:
        if tracker is not self._tracker:  # this report is from a tracker that has ended
            return
        self._report, self._reported_ns = report, self._clock()
        if report.problem or report.over:
            self.end(report.problem or (report.status and report.status.problem) or "the target was lost")
            return
        if report.action is not None and self._pilot is not None:
            if self._flying:
                self._steer(report.action)
            elif self._clock() - self._asked_ns > nanoseconds(SET_OFF_S):
                self.end(f"the tracker needed more than {SET_OFF_S:g} s: mark the target again", hover=False)
                return
            else:
                self._set_off()
        self._send_state()

    def _set_off(self) -> None:
        """Send the first set-point, ending any other flight."""
        pilot, self._pilot = self._pilot, None  # prevents clearing from ending this flight
        self._clear()
        self._pilot, self._flying, self._action = pilot, True, None
        self._watch = asyncio.get_running_loop().call_later(WATCH_S, self._on_watch)
        if self._report is not None and self._report.action is not None:
            self._steer(self._report.action)

    def _steer(self, action: AnyAction | None) -> None:
        """Send a set-point; hover if there are no new frames or the motion is unknown. On any problem, end following.

        ``action``: None if the tracker sends no reports.
        """
        pilot = self._pilot
        assert pilot is not None
        waited, self._waits = self._waits, self._stopped() or ("" if action else "the tracker is not reporting")
        try:
            if _check_in_air(pilot).failsafe is not Failsafe.NONE or (self._action and pilot.has_ended(self._action)):
                raise RefusedError("a failsafe or a lost link ended it on the way")
            if self._waits or action is None:
                self._action = None
                if not waited:
                    pilot.let_go(self._waits)
                return
            if not pilot.command(action):
                pilot.idle()  # otherwise it would still be executed if the link were restored soon
                raise LinkError(f"nothing can be sent: the link to the proxy is {pilot.link.application}")
            self._action = action
        except AuthorityError:
            self.end(NO_CONTROL)
        except SkyloopError as error:
            self.end(str(error))

    def _stopped(self) -> str:
        """Return why the vehicle can't follow now (no frames, or its motion is unknown); empty if it can."""
        report = self._report
        if report is None:
            return ""
        if report.status is not None and report.status.unknown:
            return f"{report.status.unknown}: it hovers until that is known"
        since_s = seconds(self._clock() - report.frame_ns)
        if since_s > STOPPED_S:
            return f"no new frame of {self._camera} for {since_s:.1f} s: it hovers until they come back"
        if report.frame_age_s > OLD_S:
            return f"the frames of {self._camera} are {report.frame_age_s:.1f} s old: it hovers until they are newer"
        return ""

    def _on_watch(self) -> None:
        """Hover if the tracker has sent no report for too long because its thread is stuck or starved."""
        self._watch = asyncio.get_running_loop().call_later(WATCH_S, self._on_watch)
        if self._clock() - self._reported_ns > nanoseconds(STOPPED_S):
            self._steer(None)
            self._send_state()

    # Messages to the page --------------------------------------------------------------------------------------

    def _selecting(self, camera: str, since_ns: int) -> None:
        if self._keeper is not None and self._keeper.camera == camera:
            self._send({"type": "follow", "state": "selecting", "camera": camera, "since_ns": str(since_ns)})

    def _send_state(self, state: str = "", why: str = "") -> None:
        """Send the state: changes immediately, and numbers at most once per :data:`NUMBERS_PERIOD_S`."""
        if not state:
            if self._tracker is None:
                return
            state = "tracking" if not self._flying else "waiting" if self._waits else "flying"
        report = self._report
        status = None if report is None else report.status
        phase = "starting" if status is None or report is None or not report.caught_up else str(status.phase)
        if phase != "starting" and not self._flying and state != "ended":
            phase = ""  # a control law that sends no set-points has no phase
        problem = why if state == "ended" or status is None else self._waits or status.problem
        now_ns = self._clock()
        # While the follower waits, only the age increases, which does not count as a change.
        sent = state, phase if state != "ended" else "", self._mode, self._distance_m, "" if self._waits else problem
        if sent == self._last_sent and now_ns - self._last_sent_ns < nanoseconds(NUMBERS_PERIOD_S):
            return
        self._last_sent, self._last_sent_ns = sent, now_ns
        message: Json = {"type": "follow", "state": state, "camera": self._camera, "mode": self._mode or None}
        message |= {"phase": phase, "problem": problem, "distance_m": number(self._distance_m)}
        message["size"] = None if report is None else list(report.size)
        for name in ("confidence", "range_m", "range_deviation_m", "bearing_rad", "speed_m_s", "lost_s"):
            message[name] = None if status is None else number(getattr(status, name))
        for name in ("box", "predicted_px"):
            message[name] = None if status is None else vector(getattr(status, name))
        self._send(message)

    def _camera_info(self, name: str) -> CameraInfo:
        cameras = self._drone.capabilities.cameras
        for camera in cameras:
            if camera.name == name:
                return camera
        raise UnknownNameError("camera", name, [camera.name for camera in cameras])


def in_frame(command: TrackTarget, header: FrameHeader) -> Box:
    """Convert the box in a command to pixels of the frame, even if the page received the picture in another size."""
    x, y, width, height = command.box
    if command.size is None:
        return command.box
    across, down = header.width / command.size[0], header.height / command.size[1]
    return x * across, y * down, width * across, height * down


def _check_mode(mode: str) -> None:
    if mode not in list(FollowMode):
        raise UnknownNameError("mode of following", mode, FollowMode)


def _settings(distance_m: float | None) -> ChaseSettings:
    return ChaseSettings() if distance_m is None else ChaseSettings(distance_m=distance_m)


def _check_in_air(pilot: PilotConnection) -> Feedback:
    """Return the newest feedback after checking that the vehicle is in the air and not flown by someone else."""
    feedback = pilot.feedback(max_age_s=OLD_FEEDBACK_S)
    if feedback.others:
        raise RefusedError(f"{feedback.others}: hover first to take it over")
    state = feedback.state
    if state not in UP:
        hint = "" if state.airborne else ": take off first"
        raise RefusedError(f"it can't be flown after a target: it is {state.replace('_', ' ')}{hint}")
    return feedback
