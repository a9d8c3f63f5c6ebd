"""``skyloop teleop``: flies a drone from the terminal's keyboard."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from skyloop.cli import naming
from skyloop.cli.keyboard import IGNORE_FOCUS, KEY_MAP, REPORT_FOCUS, Deflection, Hands, Keyboard, Order
from skyloop.errors import AuthorityError, SkyloopError
from skyloop.extend import Known, commands, let_go
from skyloop.messages import LinkState

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.child import CockpitProcess

ADVICE = "wait in the queue with --wait SECONDS, take over with a higher --priority, or observe: skyloop watch"
PERIOD_S: Final = 0.05  #: interval at which the position of a moved stick is resent; each press is sent immediately
REFRESH_HZ: Final = 8  #: of the display
EVENTS_SHOWN: Final = 3  #: number of newest events in the display
GAINS: Final = (0.25, 0.5, 1.0, 2.0, 4.0)  #: the gains selected by + and -


def teleop(
    name: naming.AnyNameArgument = None,
    drone: naming.DroneOption = None,
    speed: Annotated[float, typer.Option(metavar="M/S", min=0.05, max=10.0, help="Speed of a held key")] = 0.5,
    turn: Annotated[float, typer.Option(metavar="RAD/S", min=0.05, max=6.0, help="Turn rate of a held key")] = 0.8,
    priority: naming.PriorityOption = 16,
    wait: naming.WaitOption = 0.0,
    cockpit: Annotated[bool, typer.Option("--cockpit", help="Also serve a page that shows the video")] = False,
    network: naming.NetworkOption = None,
    keys: naming.KeysOption = None,
) -> None:
    """Fly with the keyboard and watch the drone's state live. It hovers when no key is held, and lands at the end.

    The keys are the same as in the cockpit: W A S D, arrows, T take off, L land, Esc Esc motors off, Q quit.
    """
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority

    naming.join_network(network, keys)
    target = naming.one_drone(name, drone)
    keyboard = Keyboard()
    authority = Authority(priority=priority, wait_s=wait)
    with connect_pilot(target, ADVICE, name="skyloop teleop", authority=authority) as flown:
        page = _page(flown) if cockpit else None
        try:
            Teleop(flown, speed, turn, "" if page is None else page.address()).run(keyboard)
        except (KeyboardInterrupt, EOFError):
            pass  # same as pressing Q: leaving the block lands the drone
        finally:
            if page is not None:
                page.close()


class Teleop:
    """One session in which a pilot flies with the keyboard."""

    def __init__(self, drone: Drone, speed: float, turn: float, page: str = "") -> None:
        self._drone = drone
        self._speed, self._turn = speed, turn
        self._page = page
        self._hands = Hands()
        self._gain = 1.0
        self._message = ""
        self._taking = threading.Thread()

    def run(self, keyboard: Keyboard) -> None:
        """Fly until Q is pressed. Raise ``EOFError`` if the terminal has been closed."""
        # Draw on a separate thread, because a stalled terminal must not delay keys.
        console = Console()
        with (
            keyboard,
            _focus_reported(console),
            Live(console=console, get_renderable=self.picture, refresh_per_second=REFRESH_HZ),
        ):
            while True:
                keys = keyboard.keys(PERIOD_S)
                for order in self._hands.step(keys, time.monotonic(), self._drone.feedback().state):
                    if order == "quit":
                        return
                    self.obey(order)
                self._message = self._hands.no_effect or keyboard.other or self._message

    def obey(self, order: Order | Deflection) -> None:
        """Carry out a command. If that is impossible, report it and change nothing.

        Only taking control waits for a reply. It uses a separate thread, so that an emergency stop still works.
        """
        if order != "take":
            self._carry_out(order)
        elif not self._taking.is_alive():
            self._taking = threading.Thread(target=self._carry_out, args=(order,), name="skyloop-take", daemon=True)
            self._taking.start()

    def _carry_out(self, order: Order | Deflection) -> None:
        try:
            if isinstance(order, Deflection):
                self._steer(order)
            else:
                self._message = self._obey(order) or self._message
        except AuthorityError as error:
            self._message = f"{error} (C takes control)"
        except SkyloopError as error:
            self._message = str(error)

    def _obey(self, order: Order) -> str:
        drone = self._drone
        if order in ("faster", "slower"):
            step = GAINS.index(self._gain) + (1 if order == "faster" else -1)
            self._gain = GAINS[max(0, min(step, len(GAINS) - 1))]
            return f"{self._speed * self._gain:g} m/s, {self._turn * self._gain:g} rad/s"
        if order == "stop":
            drone.emergency_stop()
            return "motors off"
        if order == "grounded":
            return "on the ground: T takes off"
        if order == "held":
            return "holding Esc does not stop the motors: press it twice"
        if order == "centre":
            let_go(drone, "all keys were released")
            return ""
        if order == "takeoff":
            drone.takeoff(wait=False)
        elif order == "land":
            drone.land(wait=False)
        elif order == "hover":
            if not (drone.feedback().state.airborne or commands(drone).wants_flight):  # the feedback may lag behind
                return self._obey("grounded")
            drone.hover()
        elif order == "take":
            drone.request_authority()
        elif order == "release":
            commands(drone).release(wait=False)
        return order

    def _steer(self, sticks: Deflection) -> None:
        speed, turn = self._speed * self._gain, self._turn * self._gain
        sent = self._drone.velocity(
            forward=sticks.forward * speed,
            left=sticks.left * speed,
            up=sticks.up * speed,
            yaw_rate=sticks.yaw_rate * turn,
        )
        if not sent:
            self._message = f"the keys have no effect: {self._why_not()}"

    def _why_not(self) -> str:
        """Return the reason why the newest set-point has no effect."""
        link, outcome = self._drone.link, commands(self._drone).newest_outcome
        if link.application not in (LinkState.UP, LinkState.DEGRADED):
            return f"the link is {link.application.value} ({link.reason})"
        if self._drone.authority.state != "held":
            return "control has been requested"
        return outcome.text if outcome is not None and outcome.text else "nothing can be sent now"

    def picture(self) -> Group:
        """Return the whole display, with the most important parts first; the end is cut off if it does not fit."""
        from skyloop.cli.watch import channels, events, state_panel

        drone = self._drone
        keys = Text("  ").join(Text.assemble((key, "bold"), f" {does}") for key, does in KEY_MAP)
        video = Text(self._page or f"skyloop cockpit {drone.name} shows the video", "dim")
        message = Text(self._message, "bold")
        return Group(message, state_panel(drone), keys, video, channels(drone), *events(drone, EVENTS_SHOWN))


@contextmanager
def _focus_reported(console: Console) -> Iterator[None]:
    """Ask the terminal to report whether its window has the keyboard focus."""
    try:
        console.file.write(REPORT_FOCUS if console.is_terminal else "")
        yield
    finally:
        console.file.write(IGNORE_FOCUS if console.is_terminal else "")
        console.file.flush()


def _page(drone: Drone) -> CockpitProcess:
    from skyloop.cockpit.child import CockpitProcess

    return CockpitProcess(Known(drone).reach, port=None)
