"""The four schemes of the paper over several hosts: one program and one drone, one and many, many and one, and video
to several."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.promises.hosts import flying
from tests.promises.hosts.conftest import FAST, Lan
from tests.promises.hosts.remote import Remote, RemoteError
from tests.support.processes import Process

Start = Callable[..., Process]
OnHost = Callable[..., Remote]


def test_one_program_flies_a_swarm_that_is_on_several_hosts(
    lan: Lan, start: Start, proxy: Start, remote: OnHost
) -> None:
    hangar, roof, desk = (lan.host(name) for name in ("hangar", "roof", "desk"))
    options = ("--drones", "2", "--world", "empty", "--option", "cameras=none", "--speed", "3")
    swarm = start(hangar, "-m", "skyloop", "sim", *options, "--network")
    proxy(roof, "bravo", uri=FAST)
    swarm.until("sim2")
    app = remote(desk)
    names = ["sim1", "sim2", "bravo"]
    for name in names:
        app.do(flying.connect, name)
    for name in names:
        app.do(flying.call, name, "takeoff", wait=False)
    for name in names:
        app.do(flying.wait, name, "hovering")
        app.do(flying.call, name, "velocity", forward=0.3)
    for name in names:
        app.do(flying.wait, name, "flying")


def test_several_programs_share_a_drone(lan: Lan, proxy: Start, remote: OnHost) -> None:
    hangar = lan.host("hangar")
    proxy(hangar, uri=FAST)
    bob, alice, eve = (remote(lan.host(name)) for name in ("bobs", "alices", "eves"))
    bob.do(flying.connect, "alpha", name="bob", priority=16)
    eve.do(flying.connect, "alpha", name="eve", access="observe")
    bob.do(flying.call, "alpha", "takeoff")
    eve.do(flying.wait, "alpha", "hovering")
    assert eve.do(flying.feedback, "alpha").owner == "bob"
    with pytest.raises(RemoteError, match=r"AuthorityError.*bob"):
        alice.do(flying.connect, "alpha", name="alice", priority=16)
    alice.do(flying.connect, "alpha", name="alice", priority=0)
    bob.do(flying.wait_authority, "alpha", "preempted")
    with pytest.raises(RemoteError, match=r"AuthorityError.*alice"):
        bob.do(flying.call, "alpha", "velocity", forward=0.1)
    with pytest.raises(RemoteError, match=r"AuthorityError.*observe"):
        eve.do(flying.call, "alpha", "velocity", forward=0.1)
    alice.do(flying.call, "alpha", "velocity", forward=0.2)
    eve.do(flying.wait, "alpha", "flying")
    assert eve.do(flying.feedback, "alpha").owner == "alice"
    alice.do(flying.close, "alpha")
    bob.do(flying.wait_authority, "alpha", "held")


def test_video_goes_to_several_hosts_in_the_form_each_requests(lan: Lan, proxy: Start, remote: OnHost) -> None:
    hangar = lan.host("hangar")
    proxy(hangar, uri="sim://?world=room&cameras=front&fps=15")
    wishes: dict[str, dict[str, Any]] = {
        "one": {},
        "two": {"encoding": "jpeg", "quality": 50},
        "three": {"scale": 0.5, "max_fps": 5.0},
    }
    viewers = {name: remote(lan.host(name)) for name in wishes}
    for name, wish in wishes.items():
        viewers[name].do(flying.connect, "alpha", access="observe")
        viewers[name].do(flying.watch_frames, "alpha", **wish)
    for viewer in viewers.values():
        viewer.do(flying.wait_frames, "alpha", 10)
    shapes = {
        name: {shape for _, (shape, _, _) in viewer.do(flying.frames, "alpha")} for name, viewer in viewers.items()
    }
    assert shapes == {"one": {(240, 320, 3)}, "two": {(240, 320, 3)}, "three": {(120, 160, 3)}}
    captured_ns = [at for _, (_, _, at) in viewers["three"].do(flying.frames, "alpha")]
    assert len(captured_ns) <= (captured_ns[-1] - captured_ns[0]) / 1e9 * 5.0 + 2.0, "five per second were requested"
