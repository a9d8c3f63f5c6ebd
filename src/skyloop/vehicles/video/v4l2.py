"""Local cameras known to Video4Linux: their formats, exposure and gain.

This module makes system calls directly. Layouts and numbers come from ``linux/videodev2.h``
(``Documentation/userspace-api/media/v4l``) and are the same on all architectures with 32-bit integers. FFmpeg may
stream from the device at the same time, because settings can be changed independently of a stream.
"""

from __future__ import annotations

import errno
import os
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

#: Called with a descriptor, a request and a buffer, which it modifies; raises OSError.
Ioctl = Callable[[int, int, bytearray], object]

_READ, _WRITE = 2, 1  # _IOC_READ, _IOC_WRITE
_CAPTURE: Final = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE, and V4L2_CAP_VIDEO_CAPTURE
_DEVICE_CAPS: Final = 1 << 31  # V4L2_CAP_DEVICE_CAPS
_DISCRETE: Final = 1  # V4L2_FRMSIZE_TYPE_DISCRETE, V4L2_FRMIVAL_TYPE_DISCRETE
_MOST: Final = 256  # maximum number of formats, sizes and rates, in case a device's list never ends

CAPABILITY: Final = struct.Struct("=16s32s32sIII12x")
FORMAT: Final = struct.Struct("=III32sI16x")
SIZE: Final = struct.Struct("=III6I8x")
INTERVAL: Final = struct.Struct("=IIIII6I8x")
QUERY: Final = struct.Struct("=II32siiiiI8x")
CONTROL: Final = struct.Struct("=Ii")


def _request(direction: int, number: int, layout: struct.Struct) -> int:
    """Return the request number, like the kernel's ``_IOC('V', …)``."""
    return direction << 30 | layout.size << 16 | ord("V") << 8 | number


QUERYCAP: Final = _request(_READ, 0, CAPABILITY)
ENUM_FMT: Final = _request(_READ | _WRITE, 2, FORMAT)
G_CTRL: Final = _request(_READ | _WRITE, 27, CONTROL)
S_CTRL: Final = _request(_READ | _WRITE, 28, CONTROL)
QUERYCTRL: Final = _request(_READ | _WRITE, 36, QUERY)
ENUM_FRAMESIZES: Final = _request(_READ | _WRITE, 74, SIZE)
ENUM_FRAMEINTERVALS: Final = _request(_READ | _WRITE, 75, INTERVAL)

# V4L2_CID_AUTOGAIN, V4L2_CID_GAIN, V4L2_CID_EXPOSURE_AUTO, and V4L2_CID_EXPOSURE_ABSOLUTE, in units of 100 µs.
AUTO_GAIN, GAIN, AUTO_EXPOSURE, EXPOSURE = 0x00980912, 0x00980913, 0x009A0901, 0x009A0902
_AUTO, _MANUAL, _APERTURE_FIRST = 0, 1, 3  # values of AUTO_EXPOSURE; UVC cameras use the last one for "auto"
_EXPOSURE_MS: Final = 0.1  # unit of EXPOSURE
_DISABLED: Final = 1  # V4L2_CTRL_FLAG_DISABLED

#: FFmpeg's format names by our own.
FORMATS: Final = {"mjpeg": "mjpeg", "yuyv": "yuyv422", "h264": "h264", "nv12": "nv12", "grey": "gray"}
_NAMES: Final = {"MJPG": "mjpeg", "JPEG": "mjpeg", "YUYV": "yuyv", "H264": "h264", "NV12": "nv12", "GREY": "grey"}


@dataclass(frozen=True, slots=True)
class FrameSize:
    """An image size, or a range of sizes, with its frame rates."""

    width: int  #: width [px]; for a range, the largest
    height: int
    fps: tuple[float, ...]  #: frame rates [1/s], highest first; for a range of rates, the two ends
    smallest: tuple[int, int] | None = None  #: the smallest size in a range

    def __str__(self) -> str:
        size = f"{self.width}x{self.height}"
        if self.smallest is not None:
            size = f"{self.smallest[0]}x{self.smallest[1]} to {size}"
        return size + (f" at {', '.join(f'{rate:g}' for rate in self.fps)}" if self.fps else "")


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """A pixel format that a camera supports."""

    code: str  #: the kernel's code, such as ``MJPG``
    description: str
    sizes: tuple[FrameSize, ...]

    @property
    def option(self) -> str:
        """The value of ``format=`` that selects this format; empty if there is none."""
        return _NAMES.get(self.code, "")

    def __str__(self) -> str:
        name = f"format={self.option}" if self.option else f"{self.code} ({self.description})"
        return f"{name}: {'; '.join(map(str, self.sizes)) or 'unknown sizes'}"


@dataclass(frozen=True, slots=True)
class Control:
    """A setting of the device, in the device's own unit."""

    number: int
    name: str
    minimum: int
    maximum: int
    step: int
    default: int
    value: int


class V4l2Device:
    """An open device."""

    def __init__(self, descriptor: int, ioctl: Ioctl | None = None) -> None:
        if ioctl is None:
            if sys.platform == "win32":
                raise NotImplementedError
            import fcntl

            ioctl = fcntl.ioctl
        self._descriptor = descriptor
        self._ioctl = ioctl

    def captures(self) -> bool:
        """Return whether the device captures images; raise OSError if it is not a Video4Linux device."""
        *_, everything, own = CAPABILITY.unpack(self._call(QUERYCAP, bytearray(CAPABILITY.size)))
        return bool((own if everything & _DEVICE_CAPS else everything) & _CAPTURE)

    def formats(self) -> list[PixelFormat]:
        """Return the formats, with their sizes and rates if the device reports them."""
        found = []
        for index in range(_MOST):
            answer = self._try(ENUM_FMT, FORMAT, index, _CAPTURE, 0, b"", 0)
            if answer is None:
                break
            _, _, _, description, code = answer
            found.append(PixelFormat(_fourcc(code), _text(description), tuple(self._sizes(code))))
        return found

    def control(self, number: int) -> Control | None:
        """Return a setting; None if the device does not have it."""
        answer = self._try(QUERYCTRL, QUERY, number, 0, b"", 0, 0, 0, 0, 0)
        value = self._try(G_CTRL, CONTROL, number, 0)
        if answer is None or value is None:
            return None
        _, _, name, minimum, maximum, step, default, flags = answer
        if flags & _DISABLED:
            return None
        return Control(number, _text(name), minimum, maximum, step, default, value[1])

    def set_exposure(self, exposure_ms: float | None) -> str:
        """Set the exposure [ms], or automatic exposure for None; return the reason for a failure as readable text."""
        if exposure_ms is None:
            problem = self._set(AUTO_EXPOSURE, _APERTURE_FIRST) and self._set(AUTO_EXPOSURE, _AUTO)
            return f"the camera has no automatic exposure: {problem}" if problem else ""
        known = self.control(EXPOSURE)
        if known is None:
            return "the camera's exposure can't be set"
        lowest, highest = known.minimum * _EXPOSURE_MS, known.maximum * _EXPOSURE_MS
        if not lowest <= exposure_ms <= highest:
            return f"exposure is {exposure_ms:g} ms and must be from {lowest:g} to {highest:g} for this camera"
        self._set(AUTO_EXPOSURE, _MANUAL)  # fails on a device without automatic exposure, which is harmless
        return self._set(EXPOSURE, round(exposure_ms / _EXPOSURE_MS))

    def set_gain(self, gain: int | None) -> str:
        """Set the gain in the device's own unit, or automatic gain for None; return a readable reason for a failure."""
        if gain is None:
            problem = self._set(AUTO_GAIN, 1)
            return f"the camera has no automatic gain: {problem}" if problem else ""
        known = self.control(GAIN)
        if known is None:
            return "the camera's gain can't be set"
        if not known.minimum <= gain <= known.maximum:
            return f"gain is {gain} and must be from {known.minimum} to {known.maximum} for this camera"
        self._set(AUTO_GAIN, 0)
        return self._set(GAIN, gain)

    def settings(self) -> list[str]:
        """Return readable descriptions of exposure and gain: their ranges and current values."""
        found = []
        exposure, mode = self.control(EXPOSURE), self.control(AUTO_EXPOSURE)
        if exposure is not None:
            ends = f"{exposure.minimum * _EXPOSURE_MS:g} to {exposure.maximum * _EXPOSURE_MS:g} ms"
            chosen = mode is not None and mode.value != _MANUAL
            found.append(f"exposure={ends}, now {'auto' if chosen else f'{exposure.value * _EXPOSURE_MS:g} ms'}")
        gain, auto = self.control(GAIN), self.control(AUTO_GAIN)
        if gain is not None:
            now = "auto" if auto is not None and auto.value else str(gain.value)
            found.append(f"gain={gain.minimum} to {gain.maximum}, now {now}")
        return found

    def _sizes(self, code: int) -> Iterator[FrameSize]:
        for index in range(_MOST):
            answer = self._try(ENUM_FRAMESIZES, SIZE, index, code, *[0] * 7)
            if answer is None:
                return
            _, _, kind, *numbers = answer
            if kind == _DISCRETE:
                width, height = numbers[:2]
                yield FrameSize(width, height, tuple(self._rates(code, width, height)))
            else:
                least_width, width, _, least_height, height, _ = numbers
                yield FrameSize(width, height, tuple(self._rates(code, width, height)), (least_width, least_height))
                return

    def _rates(self, code: int, width: int, height: int) -> Iterator[float]:
        for index in range(_MOST):
            answer = self._try(ENUM_FRAMEINTERVALS, INTERVAL, index, code, width, height, *[0] * 7)
            if answer is None:
                return
            kind, *numbers = answer[4:]
            for above, below in [numbers[:2]] if kind == _DISCRETE else [numbers[:2], numbers[2:4]]:
                if above:
                    yield below / above
            if kind != _DISCRETE:
                return

    def _set(self, number: int, value: int) -> str:
        try:
            self._call(S_CTRL, bytearray(CONTROL.pack(number, value)))
        except OSError as error:
            return _reason(error)
        return ""

    def _try(self, request: int, layout: struct.Struct, *numbers: object) -> tuple[int, ...] | None:
        """Return the device's reply, or None if the request failed."""
        try:
            return layout.unpack(self._call(request, bytearray(layout.pack(*numbers))))
        except OSError:
            return None

    def _call(self, request: int, buffer: bytearray) -> bytearray:
        self._ioctl(self._descriptor, request, buffer)
        return buffer


@contextmanager
def opened(path: str, ioctl: Ioctl | None = None) -> Iterator[V4l2Device]:
    """Open a device such as ``/dev/video0`` to access its settings; ``ioctl`` is as in :class:`V4l2Device`."""
    if sys.platform == "win32":
        raise NotImplementedError
    descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        yield V4l2Device(descriptor, ioctl)
    finally:
        os.close(descriptor)


def _fourcc(code: int) -> str:
    # Bit 31 marks a big-endian variant and is not part of the four characters.
    return (code & 0x7FFFFFFF).to_bytes(4, "little").decode("latin-1").strip()


def _text(field: object) -> str:
    return bytes(field).split(b"\0")[0].decode("utf-8", "replace") if isinstance(field, bytes) else ""


def _reason(error: OSError) -> str:
    if error.errno in (errno.EINVAL, errno.ENOTTY):
        return "the camera does not support this setting or value"
    return error.strerror or str(error)


_CLASS: Final = Path("/sys/class/video4linux")
_DEVICES: Final = Path("/dev")
_OTHER_SYSTEMS: Final = {"darwin": "avfoundation", "win32": "dshow"}


@dataclass(frozen=True, slots=True)
class CameraDevice:
    """A local camera."""

    path: Path | str  #: path such as ``/dev/video0``; elsewhere than on Linux, such as ``dshow://Integrated Camera``
    name: str  #: the device's name as reported by the driver
    allowed: bool  #: whether this user is allowed to open the device

    def __str__(self) -> str:
        why = "" if self.allowed else ", but this user may not open it: sudo usermod -aG video $USER, and log in again"
        return f"video://{self.path} ({self.name}){why}"


def other_cameras(device: str) -> list[CameraDevice]:
    """Return the cameras that FFmpeg lists for an input format of macOS or Windows; none if PyAV can't list them."""
    try:
        from av.device import enumerate_input_devices  # PyAV 17 or later
    except ImportError:
        return []
    try:
        found = enumerate_input_devices(device)
    except (ValueError, OSError):  # this build of FFmpeg has no such devices
        return []
    return [
        CameraDevice(f"{device}://{camera.name}", camera.description, allowed=True)
        for camera in found
        if "video" in camera.media_types
    ]


def cameras(system: Path = _CLASS, devices: Path = _DEVICES) -> list[CameraDevice]:
    """Return the local cameras in order of their numbers; an empty list if the system has no Video4Linux.

    Only the first node of each camera is listed; that node captures images.
    """
    if (device := _OTHER_SYSTEMS.get(sys.platform)) is not None:
        return other_cameras(device)
    try:
        nodes = sorted(system.iterdir(), key=lambda node: (len(node.name), node.name))
    except OSError:
        return []
    return [
        CameraDevice(path, _read(node / "name") or node.name, os.access(path, os.R_OK | os.W_OK))
        for node in nodes
        if node.name.startswith("video")
        and _read(node / "index") in ("", "0")
        and (path := devices / node.name).exists()
    ]


def described(found: list[CameraDevice]) -> str:
    """Return the list of cameras as readable text."""
    if not found:
        return "no camera is connected to this machine"
    return f"cameras of this machine: {', '.join(map(str, found))}"


def listed(camera: CameraDevice, ioctl: Ioctl | None = None) -> list[str]:
    """Return a readable description of a camera, line by line: address, formats, sizes, rates, exposure and gain."""
    if isinstance(camera.path, str):
        return [str(camera)]
    try:
        with opened(str(camera.path), ioctl) as device:
            lines = [*map(str, device.formats()), *device.settings()] if device.captures() else ["captures no images"]
    except OSError as error:
        lines = [f"can't be opened: {error.strerror or error}"]
    return [str(camera), *(f"  {line}" for line in lines)]


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
