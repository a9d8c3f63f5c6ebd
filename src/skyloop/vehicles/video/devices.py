"""The cameras of this machine, as Video4Linux lists them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skyloop.vehicles.video.v4l2 import Ioctl, opened

_CLASS: Final = Path("/sys/class/video4linux")
_DEVICES: Final = Path("/dev")


@dataclass(frozen=True, slots=True)
class CameraDevice:
    """A camera of this machine."""

    path: Path  #: such as ``/dev/video0``
    name: str  #: as its driver calls it
    allowed: bool  #: whether this user may open it

    def __str__(self) -> str:
        why = "" if self.allowed else ", but this user may not open it: sudo usermod -aG video $USER, and log in again"
        return f"video://{self.path} ({self.name}){why}"


def cameras(system: Path = _CLASS, devices: Path = _DEVICES) -> list[CameraDevice]:
    """Return the cameras of this machine, by number; none where the system has no Video4Linux.

    A camera may have several nodes: only the first, which gives pictures, is listed.

    Args:
        system: Where the kernel lists them.
        devices: Where their nodes are.
    """
    try:
        nodes = sorted(system.iterdir(), key=lambda node: (len(node.name), node.name))
    except OSError:
        return []
    return [
        CameraDevice(path, _text(node / "name") or node.name, os.access(path, os.R_OK | os.W_OK))
        for node in nodes
        if node.name.startswith("video")
        and _text(node / "index") in ("", "0")
        and (path := devices / node.name).exists()
    ]


def described(found: list[CameraDevice]) -> str:
    """Return which cameras there are, in words."""
    if not found:
        return "no camera is connected to this machine"
    return f"cameras of this machine: {', '.join(map(str, found))}"


def listed(camera: CameraDevice, ioctl: Ioctl | None = None) -> list[str]:
    """Return what a camera offers, in lines for people: its address, then formats, sizes, rates, exposure and gain.

    Args:
        camera: Of this machine.
        ioctl: The kernel's call, as for :class:`V4l2Device`.
    """
    try:
        with opened(str(camera.path), ioctl) as device:
            told = [*map(str, device.formats()), *device.settings()]
            lines = told if device.captures() else ["gives no pictures"]
    except OSError as error:
        lines = [f"can't be opened: {error.strerror or error}"]
    return [str(camera), *(f"  {line}" for line in lines)]


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
