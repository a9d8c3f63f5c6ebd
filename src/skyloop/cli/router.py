"""``skyloop router``: joins proxies and applications that can't reach one another."""

from __future__ import annotations

import signal
import threading
from contextlib import ExitStack
from types import FrameType
from typing import Annotated

import typer

from skyloop.cli.naming import MULTICAST, network_places
from skyloop.cli.network import (
    ConnectOption,
    KeysOption,
    ListenOption,
    MetricsOption,
    MulticastOption,
    announce,
    places,
)

PORT = 7447
_POLL_S = 0.2


def router(
    network: Annotated[
        str,
        typer.Option(
            "--network",
            metavar="WHERE",
            help="What to join: multicast, or other routers' addresses with commas",
            autocompletion=network_places,
        ),
    ] = MULTICAST,
    listen: ListenOption = None,
    connect: ConnectOption = None,
    multicast: MulticastOption = True,
    keys: KeysOption = None,
    metrics: MetricsOption = None,
    print_config: Annotated[
        bool,
        typer.Option("--print-config", help="Only print the configuration, for Zenoh's own router: zenohd -c FILE"),
    ] = False,
) -> None:
    """Pass on what proxies and applications of several networks say, until Ctrl-C.

    Each of them connects to a router that it can reach; routers connect to each other.
    """
    from skyloop.network import config
    from skyloop.network.config import Part
    from skyloop.network.session import Session, acquire, release, renewed

    everywhere = f"{config.all_interfaces()}:{PORT}"
    chosen = places(network, listen or [everywhere], connect, multicast, keys)
    if chosen.identity is not None:
        chosen.identity.require_router()
    if print_config:
        typer.echo(config.to_json(config.make(chosen, Part.ROUTER)))
        return
    if chosen.tls is None:
        typer.echo(
            "WARNING: a router without keys: anyone who reaches it can watch and fly what is behind it", err=True
        )
    ended = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        ended.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    session: Session = acquire(chosen, Part.ROUTER)
    with ExitStack() as beside:
        if metrics is not None:
            from skyloop.metrics import router_readings, serve

            announce(beside.enter_context(serve(lambda: [router_readings(lambda: session)], metrics)).announcement)
        typer.echo(f"ready: a router at {', '.join(session.listens)}")
        while not ended.wait(_POLL_S):  # looks up now and then: the kernel may hand a signal to any thread
            if chosen.ring is None:
                continue
            for change in chosen.ring.poll():
                typer.echo(f"skyloop: {change}", err=True)
            out = session.shut_out()
            if out:
                typer.echo(f"skyloop: reconnecting without {', '.join(sorted(out))}", err=True)
                session = renewed(session)
                chosen = session.settings
    release(session, linger=False)
