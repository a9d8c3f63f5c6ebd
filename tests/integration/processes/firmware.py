"""Emulated MAVLink firmware of ``skyloop sim``."""

from __future__ import annotations

import re

import skyloop
from tests.support.processes import eventually

ADDRESS = re.compile(r"mavlink://udpin:[0-9.]+:\d+")
KINDS = ("arducopter", "px4")


def wait_until_ready(drone: skyloop.Drone) -> None:
    eventually(lambda: bool((drone.feedback().native or {}).get("mavlink.ready")), "it may be armed", 30.0)
