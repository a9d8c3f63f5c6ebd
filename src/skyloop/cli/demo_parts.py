"""What demonstrations share besides their flights: the drone with its page, and an orderly end by Ctrl-C."""

from __future__ import annotations

import signal
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.console import Console

from skyloop.errors import LinkError

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.child import CockpitProcess

_FIRST_PICTURE_S: Final = 10.0

#: Option of a demonstration.
PagePort = Annotated[
    int | None, typer.Option(min=0, max=65535, help="Of the page; 0 takes a free one [8420, or the next free one]")
]


@contextmanager
def drone_and_page(
    uri: str,
    console: Console,
    name: str,
    stop: Callable[[], None],
    port: int | None,
    *,
    page_shown: bool,
    browser: bool,
) -> Iterator[tuple[Drone, CockpitProcess | None, float]]:
    """Connect to a vehicle, wait for its first picture, and show the page.

    Args:
        uri: The vehicle's.
        console: To print on.
        name: Who flies, for those who watch.
        stop: Called on the first Ctrl-C.
        port: Of the page; None: the default one of pages.
        page_shown: Whether there is a page.
        browser: Whether to open it in the browser.

    Yields:
        The drone, the page if there is one, and when the first picture had come (monotonic) [s].

    Raises:
        SkyloopError: Those of connecting.
    """
    from skyloop.client import connect
    from skyloop.cockpit.child import CockpitProcess

    with ExitStack() as stack:
        drone = stack.enter_context(connect(uri, name=name))
        stack.enter_context(interrupted_by_signals(stop))
        console.print(f"[bold]{uri}[/] is up as [bold]{drone.name}[/]")
        page = stack.enter_context(CockpitProcess(drone.name, port)) if page_shown else None
        drone.next_frame(timeout_s=_FIRST_PICTURE_S)
        pictured_s = time.monotonic()
        if page is not None:
            _show(page, console, browser)
        yield drone, page, pictured_s


def _show(page: CockpitProcess, console: Console, browser: bool) -> None:
    """Show the page's address, and open it; a demonstration goes on without its page."""
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
