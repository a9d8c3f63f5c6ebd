"""Two network namespaces joined by a cable, for programs whose ports and addresses can't be chosen."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest


@dataclass(frozen=True)
class Cable:
    """The command prefixes that start a program at either end."""

    drone: tuple[str, ...]
    pilot: tuple[str, ...]


@contextmanager
def cable(drone_address: str, pilot_address: str) -> Iterator[Cable]:
    """Skips where namespaces aren't available: without root's rights, or without iproute2's ``ip``."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and the program ip")
    ends = {"drone": drone_address, "pilot": pilot_address}
    names = {end: f"skyloop-{end}-{os.getpid()}" for end in ends}
    wires = {end: f"sky{end[0]}{os.getpid()}" for end in ends}
    try:
        try:
            for name in names.values():
                _ip("netns", "add", name)
            _ip("link", "add", wires["drone"], "type", "veth", "peer", "name", wires["pilot"])
            for end, address in ends.items():
                _ip("link", "set", wires[end], "netns", names[end])
                _ip("-n", names[end], "addr", "add", f"{address}/24", "dev", wires[end])
                _ip("-n", names[end], "link", "set", wires[end], "up")
                _ip("-n", names[end], "link", "set", "lo", "up")
        except subprocess.CalledProcessError as error:
            pytest.skip(f"network namespaces can't be made here: {error.stderr.strip()}")
        yield Cable(*(("ip", "netns", "exec", names[end]) for end in ends))
    finally:
        for name in names.values():
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], capture_output=True, text=True, check=True, timeout=20)
