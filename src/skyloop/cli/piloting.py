"""Connecting as a pilot from the command line."""

from __future__ import annotations

from typing import Unpack

from skyloop.client import Drone, connect
from skyloop.client.connect import ConnectOptions
from skyloop.errors import AuthorityError


def connect_pilot(target: str, advice: str, **options: Unpack[ConnectOptions]) -> Drone:
    """Connect as :func:`skyloop.connect` does; where another client flies, the error names it and says what to do."""
    try:
        return connect(target, **options)
    except AuthorityError as error:
        if error.code != "busy":
            raise
        from skyloop.cli.listing import describe

        holder = describe(target).owner or "another application"
        raise AuthorityError(f"{holder} holds the authority over {target}: {advice}", code=error.code) from error
