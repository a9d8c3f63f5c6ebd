"""Access a drone beyond its public API, for Skyloop's controllers, recorder, cockpit, processors, ROS and CLI.

Only the client uses a drone's private attributes. Every other package uses this module, which may change in any
version. All functions are thread-safe and return immediately unless their docstring says otherwise.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Final, Protocol, TypedDict, TypeVar, Unpack

if TYPE_CHECKING:
    from skyloop.client import ChannelStats, Drone, Listener
    from skyloop.client.drone import DroneOptions
    from skyloop.client.publishing import Membership
    from skyloop.client.telemetry import Mailboxes
    from skyloop.client.video import StreamChannel, StreamOptions, VideoChannel
    from skyloop.errors import SkyloopError
    from skyloop.messages import AnyAction, Feedback, Outcome
    from skyloop.transport.base import Dialer

D = TypeVar("D", bound="Drone")


class Known:
    """What this process knows about a drone. Reading it sends nothing, subscribes to nothing, and raises no errors."""

    def __init__(self, drone: Drone) -> None:
        self._drone, state = drone, drone._state
        self.app: Final = state.app  #: name of this application, as it appears in events
        self.reach: Final = drone._reach  #: name or address at which others can reach the vehicle; None: they can't
        self.subscriber: Final = state.video.subscriber  #: name unique to this drone object, for :func:`stream_channel`

    @property
    def newest(self) -> Feedback | None:
        """The newest feedback, regardless of its age; None before the first sample arrives."""
        return self._drone._state.newest

    @property
    def is_ending(self) -> bool:
        """Whether the flight is ending or the drone is closed; commands then raise :class:`ClosedError`."""
        return self._drone._piloting.ending

    @property
    def is_far(self) -> bool:
        """Whether frames arrive over a network, in the encoding that each consumer requests."""
        return self._drone._connection.adapts_frames

    @property
    def listeners(self) -> list[Listener[Any]]:
        """Active callbacks of the application."""
        return list(self._drone._state.listeners)

    @property
    def stats(self) -> dict[str, ChannelStats]:
        """Statistics by channel, like :attr:`skyloop.Drone.stats`, but without a request to the proxy."""
        return self._drone._state.stats(self._drone._commands.sends)


class Commands(Protocol):
    """This application's commands and their outcomes. Each command is an intent, which has a number."""

    @property
    def newest(self) -> AnyAction: ...  #: the set-point being repeated; ``Idle`` if there is none
    @property
    def intent(self) -> int: ...  #: number of the newest intent
    @property
    def wants_flight(self) -> bool: ...  #: whether the newest set-point keeps the vehicle in the air or brings it there
    @property
    def may_ask(self) -> bool: ...  #: whether a proxy is connected and this application holds the authority
    @property
    def newest_outcome(self) -> Outcome | None: ...  #: the proxy's newest report about these intents

    def outcome(self, intent: int) -> Outcome | None: ...  #: how the intent ended; None while it is in progress
    def release(self, *, wait: bool = True) -> None: ...  #: give up the authority; may raise NoAnswerError
    def answer(self, lease: int, app_id: int, grant: bool, reason: str, *, wait: bool = False) -> None:
        """Answer a request to hand over the authority; see :meth:`skyloop.client.commands.CommandSender.answer`."""

    # Whether the person flying is present. While presence is required but lacking, set-points are not repeated and new
    # set-points are refused. Commands that end a flight are still sent once, and emergency stops always work.
    def flown_by_person(self) -> None: ...  #: require the person's presence from now on
    def present_until(self, until_ns: int) -> None: ...  #: on this process's clock [ns]; never shortens the time
    def is_present(self, now_ns: int) -> bool: ...  #: also True if presence is not required


def commands(drone: Drone) -> Commands:
    """Return this application's commands and outcomes; :meth:`skyloop.Drone.command` and :func:`ask` send commands."""
    return drone._commands


def ask(drone: Drone, action: AnyAction) -> int:
    """Send ``action``, whose numbers are valid, as :meth:`skyloop.Drone.command` does; return the intent's number."""
    return drone._commands.ask(action)


def let_go(drone: Drone, reason: str, *, land: bool = False, for_good: bool = False) -> bool:
    """Hover or land because the library, rather than a person, has decided to do so. Never raises.

    Does nothing if someone else flies the vehicle, if it is landing or returning, or if the application itself landed
    or stopped it. A take-off without visible effect is cancelled. Without the authority, only the set-point is dropped.

    ``land``: whether to land rather than hover. ``for_good``: whether later commands of the application, except for an
    emergency stop, raise :class:`ClosedError`. Returns whether anything was sent; the log states the ``reason``.
    """
    if for_good:
        drone._commands.bar()
    return drone._piloting.let_go(reason, land=land)


def open_unasked(kind: type[D], dial: Dialer, *, app: str, timeout_s: float, **options: Unpack[DroneOptions]) -> D:
    """Connect as a pilot without requesting the authority yet. Waits for the first feedback.

    ``kind`` is ``Drone`` or a subclass, and ``app`` the application's name (1 to 64 characters). ``timeout_s`` limits
    the wait for the proxy to answer and to send feedback. Raises the same errors as :func:`skyloop.connect`.
    """
    drone = kind(dial, app=app, **options)
    drone._connect(timeout_s=timeout_s, acquire=False)
    return drone


def connect_to_stop(name: str, app: str) -> Drone:
    """Connect to a running proxy as a pilot, without waiting for feedback and without ever requesting the authority.

    Raises the same errors as :func:`skyloop.connect`.
    """
    from skyloop.client.connect import prepare

    drone, deadline_s = prepare(name, name=app, on_exit="hover")
    drone._connect(timeout_s=deadline_s - time.monotonic(), acquire=False, wait_for_state=False)
    return drone


def end_flight(drone: Drone, report: Callable[[str], object]) -> SkyloopError | None:
    """If this application flies the vehicle, land (and wait) or hover, depending on ``on_exit``; then close the drone.

    ``report`` is called on this thread with a message for each step. Returns the error, or None if everything worked.
    """
    return drone._piloting.end_flight(report)


def video_channel(
    drone: Drone, camera: str | None = None, *, max_fps: float | None = None, part: tuple[int, int] | None = None
) -> VideoChannel:
    """Return the channel of a camera's frames; the channel calls its consumers on the receiving thread.

    Arguments and errors are those of :meth:`skyloop.Drone.frames`.
    """
    return drone._state.video.channel(camera, max_fps=max_fps, part=part)


def stream_channel(drone: Drone, camera: str | None = None, **how: Unpack[StreamOptions]) -> StreamChannel:
    """Return the channel of a camera's H.264 frames; without options, frames arrive as the vehicle encoded them.

    Consumers are called on the receiving thread. Raises the same errors as :func:`video_channel`.
    """
    return drone._state.video.stream(camera, **how)


class InboxOptions(TypedDict, total=False):
    """Options of :func:`inbox`: the samples for which a thread waits."""

    feedback: bool  #: whether feedback is wanted (default: True)
    frames: bool  #: whether frames are wanted (default: True)
    camera: str | None  #: name of the camera; None: the vehicle's first camera
    results: bool  #: whether the results of processors are wanted
    processors: Iterable[str] | None  #: names of the processors whose results are wanted; None: all processors
    max_age_s: float | None  #: maximum age of a result [s]; None: no limit


def inbox(drone: Drone, **wanted: Unpack[InboxOptions]) -> Mailboxes:
    """Return mailboxes for the newest feedback, frame and results; one thread can wait for all of them.

    The mailboxes are a context manager, and receive samples while it is open. Raises the same errors as
    :func:`video_channel`.
    """
    from skyloop.client.telemetry import Mailboxes

    return Mailboxes(drone._state, **wanted)


def join_processor(
    drone: Drone, name: str, *, code: str, camera: str | None = None, shared: bool = True, timeout_s: float = 5.0
) -> Membership:
    """Become a worker of a processor, as ``skyloop process`` does, until the drone is closed. Waits for an answer.

    Args:
        drone: The drone whose frames the worker processes.
        name: Name of the processor.
        code: Identifies the code, which must be the same for all workers with this name; at most 128 characters.
        camera: Name of the camera; None: the vehicle's first.
        shared: If True, each frame goes to only one worker; if False, each worker gets all frames.
        timeout_s: Maximum time to wait [s].

    Raises:
        NameTakenError: If another application runs different code under this name.
        RefusedError: If the proxy refuses for another reason.
        NoAnswerError: If the proxy does not answer in time.
        UsageError: If ``name`` or ``code`` is invalid, or if called from an inline callback.
        UnknownNameError: If the vehicle has no camera of this name.
    """
    from skyloop.client.publishing import Membership

    state = drone._state
    membership = Membership(
        drone._connection, state, name, code, lambda: state.video.channel(camera).camera.name, shared=shared
    )
    membership.start(timeout_s)
    return membership
