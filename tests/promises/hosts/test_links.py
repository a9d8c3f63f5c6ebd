"""Broken links between hosts: notification, the vehicle's behaviour meanwhile, and recovery."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from skyloop.messages import Applied, Velocity
from tests.promises.hosts import flying
from tests.promises.hosts.conftest import Lan
from tests.promises.hosts.remote import Remote

Start = Callable[..., object]
OnHost = Callable[..., Remote]
S = 1_000_000_000


@pytest.mark.parametrize(("down", "up"), [("cut", "restore"), ("unplug", "plug")])
def test_a_link_cut_and_restored_is_back_within_two_seconds_with_its_state_restored(
    lan: Lan, proxy: Start, remote: OnHost, down: str, up: str
) -> None:
    """The application is notified, and does nothing itself. A cut is silent, as by radio; an unplugged cable is not."""
    hangar, desk = lan.host("hangar"), lan.host("desk")
    proxy(hangar, uri="sim://?world=empty&cameras=front")
    app = remote(desk)
    app.do(flying.connect, "alpha", priority=5)
    app.do(flying.watch_frames, "alpha")
    app.do(flying.wait_frames, "alpha", 3)
    app.do(flying.set_parameter, "alpha", "limits.tilt", 0.21)

    getattr(lan.segment, down)(desk)
    cut_ns = time.monotonic_ns()
    lost_ns = app.do(flying.wait_link, "alpha", "lost", cut_ns)
    assert lost_ns - cut_ns < 5.0 * S
    assert app.do(flying.call, "alpha", "velocity", forward=0.3) is False, "no vehicle to command, and no exception"
    time.sleep(max(0.0, 3.0 - (time.monotonic_ns() - cut_ns) / S))  # so that all retries of all layers are slow by now
    getattr(lan.segment, up)(desk)
    back_ns = time.monotonic_ns()
    up_ns = app.do(flying.wait_link, "alpha", "up", back_ns)
    held_ns = app.do(flying.wait_authority, "alpha", "held")
    frame_ns = app.do(flying.wait_frames, "alpha", 1, back_ns)
    took_s = {name: (at - back_ns) / S for name, at in (("link", up_ns), ("authority", held_ns), ("video", frame_ns))}
    assert max(took_s.values()) < 6.0, took_s
    assert app.do(flying.priority, "alpha") == 5
    assert app.do(flying.parameter, "alpha", "limits.tilt") == pytest.approx(0.21)
    app.do(flying.call, "alpha", "takeoff")
    app.do(flying.wait, "alpha", "hovering")


def test_a_pilot_cut_off_leaves_a_vehicle_that_fails_safe_and_executes_nothing_old_on_return(
    lan: Lan, proxy: Start, remote: OnHost
) -> None:
    hangar, desk = lan.host("hangar"), lan.host("desk")
    proxy(hangar)
    witness, pilot = remote(hangar), remote(desk)
    witness.do(flying.connect, "alpha", access="observe")
    witness.do(flying.watch_commands, "alpha")
    pilot.do(flying.connect, "alpha")
    pilot.do(flying.call, "alpha", "takeoff")
    pilot.do(flying.wait, "alpha", "hovering")
    pilot.do(flying.keep_flying, "alpha")
    witness.do(flying.wait, "alpha", "flying")

    lan.segment.cut(desk)
    cut_ns = time.monotonic_ns()
    hover_ns = witness.do(flying.wait_failsafe, "alpha", "hover")
    assert 0.3 * S < hover_ns - cut_ns < 1.5 * S, "failsafe.hover_after_s is 0.5 s after the last command"
    witness.do(flying.wait, "alpha", "hovering")
    pilot.do(flying.wait_link, "alpha", "lost", cut_ns)
    time.sleep(max(0.0, 2.5 - (time.monotonic_ns() - cut_ns) / S))  # the pilot keeps commanding, without effect

    lan.segment.restore(desk)
    back_ns = time.monotonic_ns()
    pilot.do(flying.wait_authority, "alpha", "held")
    witness.do(
        flying.wait_failsafe, "alpha", "none", timeout_s=30.0
    )  # its controller kept running: the first new command
    witness.do(flying.wait, "alpha", "flying")
    pilot.do(flying.stop_flying, "alpha")

    applied: list[Applied] = witness.do(flying.commands, "alpha")
    late = [a for a in applied if isinstance(a.applied, Velocity) and cut_ns + S < a.applied_ns]
    assert late, "the pilot does not fly again"
    # All hosts here share one clock, so the time of sending is the pilot's own.
    stale = [a for a in late if a.sent_ns < back_ns - 0.25 * S]
    assert not stale, f"{len(stale)} commands from before the return were executed"
    assert min(a.applied_ns for a in late) >= back_ns


def test_a_pilot_that_stays_cut_off_is_landed(lan: Lan, proxy: Start, remote: OnHost) -> None:
    hangar, desk = lan.host("hangar"), lan.host("desk")
    proxy(hangar)
    witness, pilot = remote(hangar), remote(desk)
    witness.do(flying.connect, "alpha", access="observe")
    pilot.do(flying.connect, "alpha")
    pilot.do(flying.set_parameter, "alpha", "failsafe.land_after_s", 1.5)
    pilot.do(flying.call, "alpha", "takeoff")
    pilot.do(flying.wait, "alpha", "hovering")
    lan.segment.cut(desk)
    cut_ns = time.monotonic_ns()
    witness.do(flying.wait_failsafe, "alpha", "land")
    assert 1.2 * S < time.monotonic_ns() - cut_ns < 7.0 * S
    witness.do(flying.wait, "alpha", "landed")
    assert witness.do(flying.feedback, "alpha").owner is None
