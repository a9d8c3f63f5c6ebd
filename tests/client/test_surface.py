"""What an application sees of a drone and a swarm: what is for Skyloop's own packages lies elsewhere."""

from __future__ import annotations

from skyloop.client import Config, Drone, Swarm, TakeoverRequest

INSIDE = {"open", "leave", "open_ns", "inbox", "channel", "result_channel", "join_processor", "reach", "granted"} | {
    "disconnected",
    "check_policy",
    "lease",
    "by_id",
}


def test_internals_are_out_of_sight() -> None:
    for kind in (Drone, Swarm, Config, TakeoverRequest):
        assert not INSIDE & set(dir(kind)), kind.__name__
