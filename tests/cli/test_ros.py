"""``skyloop ros``: the effect of its options, and its message without rclpy. tests/ros tests the bridge itself."""

from __future__ import annotations

import sys
from types import SimpleNamespace, TracebackType
from typing import Any

import pytest

import skyloop.ros
from tests.support.commands import Run


def test_without_rclpy_it_says_what_to_install(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    ended = run("ros", "alpha")
    assert ended.code == 1
    assert "skyloop install ros" in ended.err


def test_options(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    class Bridge:
        namespaces = {"alpha": "alpha"}  # noqa: RUF012
        drones = {"alpha": SimpleNamespace(uri="sim://")}  # noqa: RUF012

        def __init__(self, settings: Any) -> None:
            given.append(settings)

        def __enter__(self) -> Bridge:
            return self

        def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
        ) -> None:
            pass

        def run(self) -> None:
            raise KeyboardInterrupt

    monkeypatch.setattr(skyloop.ros, "Bridge", Bridge)
    words = ["--priority", "4", "--cmd-vel-timeout", "0.3", "--map", "map", "--use-sim-time", "--domain", "7"]
    ended = run("ros", "alpha", "--drone", "beta", *words, "--ros-args", "-r 'cmd_vel:=teleop one'")
    assert (ended.code, ended.out) == (0, "ready /alpha: alpha, sim://\n")
    assert given == [
        skyloop.ros.Settings(
            drones=("alpha", "beta"),
            priority=4,
            timeout_s=0.3,
            map_frame="map",
            use_sim_time=True,
            domain=7,
            arguments=("-r", "cmd_vel:=teleop one"),
        )
    ]


def test_nonsense_is_refused(run: Run) -> None:
    assert run("ros", "alpha", "--domain", "500").code == 2
    assert "0 to 101" in run("ros", "alpha", "--domain", "500").err
    assert run("ros").code == 2
