"""What demonstrations share besides their flights: the page beside them, and a Ctrl-C that ends them in good order."""

from __future__ import annotations

import signal
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

from rich.console import Console

from skyloop.errors import LinkError

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.child import CockpitProcess


def show_page(page: CockpitProcess, console: Console, browser: bool) -> None:
    """Show the page's address, and open it; a demo goes on without its page."""
    try:
        address = page.address()
    except LinkError as error:
        console.print(f"[yellow]no page:[/] {error}")
        return
    console.print(f"watch it at [bold cyan]{address}[/]")
    if browser:
        webbrowser.open(address)


def land(drone: Drone, console: Console) -> None:
    """Land, unless somebody else flies the drone."""
    status = drone.authority
    if status.state != "held":
        console.print(f"[yellow]{status.holder or 'another application'} took over: the drone is left to it[/]")
        return
    console.print("landing")
    drone.land()


@contextmanager
def interrupted_by_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` on SIGINT and SIGTERM; a second one of either acts as it did before."""
    before: dict[int, Any] = {}

    def put_back() -> None:
        while before:
            number, handler = before.popitem()
            signal.signal(number, handler)

    def handle(_number: int, _frame: FrameType | None) -> None:
        put_back()
        stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, handle)
    try:
        yield
    finally:
        put_back()
