"""Other libraries carry the same samples by the same contract; how fast they are is no matter of a test."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import pytest

from benchmarks.measuring.pair import Pair
from benchmarks.measuring.schedule import CHANNELS, Turn
from benchmarks.measuring.workers import Workers
from benchmarks.peers import PEERS, chosen, find
from skyloop.errors import UnknownNameError

SHORT_S = 0.5
pytestmark = pytest.mark.process


@pytest.mark.parametrize("name", list(PEERS))
def test_a_peer_carries_everything(name: str) -> None:
    found, skipped = find([name])
    if not found:
        pytest.skip(skipped[name])
    [peer] = found
    turn = Turn(0, SHORT_S)
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, Workers() as workers:
        pair = Pair(workers, peer.module, folder, python=peer.python)
        arrivals = pair.measure(turn)
    for channel in CHANNELS:
        assert 0.6 * turn.count(channel) <= len(arrivals[channel]) <= turn.count(channel)
        assert all(sent_ns < received_ns for sent_ns, received_ns in arrivals[channel])


def test_what_is_not_installed_is_left_out_with_a_reason(tmp_path: Path) -> None:
    found, skipped = find(["ros2"], str(tmp_path / "python"))
    assert found == []
    assert "does not run" in skipped["ros2"]
    assert "ros-rclpy" in skipped["ros2"]
    bare = tmp_path / "python3"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')  # an interpreter without any package
    bare.chmod(0o755)
    found, skipped = find(["ros2"], str(bare))
    assert "No module named" in skipped["ros2"]


def test_peers_by_name() -> None:
    assert chosen("all") == list(PEERS)
    assert chosen("none") == []
    assert chosen("zeromq, zenoh,zeromq") == ["zeromq", "zenoh"]
    with pytest.raises(UnknownNameError, match="did you mean 'zenoh'"):
        chosen("zenho")
