"""Video4Linux with the kernel's own structures, filled by hand like a webcam's: no device is needed."""

from __future__ import annotations

import errno
import os
import struct
from pathlib import Path

import pytest

from skyloop.drivers.live_camera import source_of
from skyloop.errors import UsageError
from skyloop.vehicles.video import v4l2
from skyloop.vehicles.video.driver import DeviceOptions
from skyloop.vehicles.video.v4l2 import CameraDevice, FrameSize, PixelFormat, V4l2Device, listed
from tests.support.systems import only_on

MJPG, YUYV, BGR = (int.from_bytes(code, "little") for code in (b"MJPG", b"YUYV", b"BGR3"))


class Webcam:
    """Answers like the driver of a USB camera."""

    def __init__(self) -> None:
        self.values = {v4l2.AUTO_EXPOSURE: 3, v4l2.EXPOSURE: 157, v4l2.GAIN: 64, v4l2.AUTO_GAIN: 1}
        self.ranges = {
            v4l2.EXPOSURE: (1, 5000),
            v4l2.GAIN: (0, 255),
            v4l2.AUTO_EXPOSURE: (0, 3),
            v4l2.AUTO_GAIN: (0, 1),
        }
        self.capabilities = 0x84A00001, 0x04200001
        self.formats = [
            (MJPG, b"Motion-JPEG"),
            (YUYV, b"YUYV 4:2:2"),
            (BGR, b"BGR"),
            (BGR | 1 << 31, b"BGR, big-endian"),
        ]
        self.sizes = {MJPG: [(1280, 720), (640, 480)], YUYV: [(640, 480)]}
        self.rates = {(MJPG, 1280): [(1, 30), (1, 15)], (MJPG, 640): [(1001, 30000)], (YUYV, 640): [(1, 10), (0, 1)]}
        self.refused: dict[int, OSError] = {}  # by the control's number

    def __call__(self, descriptor: int, request: int, buffer: bytearray) -> None:
        assert descriptor == 7
        index = int.from_bytes(buffer[:4], "little")
        try:
            answer = self.answer(request, index, bytes(buffer))
        except (LookupError, StopIteration):
            raise OSError(errno.EINVAL, "Invalid argument") from None
        assert len(answer) == len(buffer)
        buffer[:] = answer

    def answer(self, request: int, index: int, asked: bytes) -> bytes:
        code = int.from_bytes(asked[4:8], "little")
        if request == v4l2.QUERYCAP:
            return struct.pack(
                "=16s32s32sIII12x", b"uvcvideo", b"HD Webcam", b"usb-0000:00:14.0-1", 393216, *self.capabilities
            )
        if request == v4l2.ENUM_FMT:
            format_code, text = self.formats[index]
            return struct.pack("=III32sI16x", index, 1, 0, text, format_code)
        if request == v4l2.ENUM_FRAMESIZES:
            if code == BGR and index == 0:
                return struct.pack("=III6I8x", index, code, 3, 32, 1920, 8, 24, 1080, 8)
            return struct.pack("=III6I8x", index, code, 1, *self.sizes[code][index], 0, 0, 0, 0)
        if request == v4l2.ENUM_FRAMEINTERVALS:
            width = int.from_bytes(asked[8:12], "little")
            head = asked[:16]
            if code == BGR and index == 0:
                return head + struct.pack("=I6I8x", 3, 1, 60, 1, 5, 0, 1)
            return head + struct.pack("=I6I8x", 1, *self.rates[code, width][index], 0, 0, 0, 0)
        if request == v4l2.QUERYCTRL:
            low, high = self.ranges[index]
            return struct.pack("=II32siiiiI8x", index, 1, b"Setting", low, high, 1, low, 0)
        if request == v4l2.G_CTRL:
            return struct.pack("=Ii", index, self.values[index])
        assert request == v4l2.S_CTRL
        if index in self.refused:
            raise self.refused[index]
        value = struct.unpack("=Ii", asked)[1]
        assert self.ranges[index][0] <= value <= self.ranges[index][1]
        self.values[index] = value
        return asked


@pytest.fixture
def webcam() -> Webcam:
    return Webcam()


def test_requests_are_the_kernels() -> None:
    # As printed by a C program with linux/videodev2.h, on x86-64.
    assert (v4l2.QUERYCAP, v4l2.ENUM_FMT, v4l2.QUERYCTRL) == (0x80685600, 0xC0405602, 0xC0445624)
    assert (v4l2.G_CTRL, v4l2.S_CTRL) == (0xC008561B, 0xC008561C)
    assert (v4l2.ENUM_FRAMESIZES, v4l2.ENUM_FRAMEINTERVALS) == (0xC02C564A, 0xC034564B)


def test_formats_sizes_and_rates_are_listed(webcam: Webcam) -> None:
    found = V4l2Device(7, webcam).formats()
    assert found[0] == PixelFormat(
        "MJPG",
        "Motion-JPEG",
        (FrameSize(1280, 720, (30.0, 15.0)), FrameSize(640, 480, (30000 / 1001,))),
    )
    assert list(map(str, found)) == [
        "format=mjpeg: 1280x720 at 30, 15; 640x480 at 29.97",
        "format=yuyv: 640x480 at 10",
        "BGR3 (BGR): 32x24 to 1920x1080 at 60, 5",
        "BGR3 (BGR, big-endian): unknown sizes",
    ]


def test_a_node_without_images_is_not_listed(webcam: Webcam) -> None:
    assert V4l2Device(7, webcam).captures()
    webcam.capabilities = 0x84A00001, 0x04A00000  # the device captures images, this node gives metadata
    assert not V4l2Device(7, webcam).captures()
    webcam.capabilities = 0x00000001, 0
    assert V4l2Device(7, webcam).captures()


def test_settings_are_described(webcam: Webcam) -> None:
    device = V4l2Device(7, webcam)
    assert device.settings() == ["exposure=0.1 to 500 ms, now auto", "gain=0 to 255, now auto"]
    webcam.values.update({v4l2.AUTO_EXPOSURE: 1, v4l2.AUTO_GAIN: 0})
    assert device.settings() == ["exposure=0.1 to 500 ms, now 15.7 ms", "gain=0 to 255, now 64"]
    webcam.ranges.clear()
    assert device.settings() == []


def test_exposure_and_gain_are_set_manually_and_automatic_again(webcam: Webcam) -> None:
    device = V4l2Device(7, webcam)
    assert DeviceOptions(exposure=8.0, gain=12).apply(device) == []
    assert webcam.values == {v4l2.AUTO_EXPOSURE: 1, v4l2.EXPOSURE: 80, v4l2.GAIN: 12, v4l2.AUTO_GAIN: 0}
    assert DeviceOptions(exposure="auto", gain="auto").apply(device) == []
    assert (webcam.values[v4l2.AUTO_EXPOSURE], webcam.values[v4l2.AUTO_GAIN]) == (3, 1)
    assert DeviceOptions().apply(device) == []


def test_a_refused_setting_is_reported_with_its_range(webcam: Webcam) -> None:
    device = V4l2Device(7, webcam)
    assert device.set_exposure(900.0) == "exposure is 900 ms and must be from 0.1 to 500 for this camera"
    assert device.set_gain(256) == "gain is 256 and must be from 0 to 255 for this camera"
    webcam.refused = {v4l2.EXPOSURE: OSError(errno.EBUSY, "Device or resource busy")}
    assert device.set_exposure(10.0) == "Device or resource busy"
    webcam.ranges.clear()
    assert device.set_exposure(10.0) == "the camera's exposure can't be set"
    assert device.set_gain(3) == "the camera's gain can't be set"
    assert "no automatic exposure: the camera does not support this setting" in device.set_exposure(None)
    assert "no automatic gain" in device.set_gain(None)


def test_a_disabled_setting_is_none(webcam: Webcam) -> None:
    answer = webcam.answer

    def off(request: int, index: int, asked: bytes) -> bytes:
        given = answer(request, index, asked)
        return given[:56] + struct.pack("=I8x", 1) if request == v4l2.QUERYCTRL else given

    webcam.answer = off  # type: ignore[method-assign]
    assert V4l2Device(7, webcam).control(v4l2.GAIN) is None


@only_on("linux", reason="cameras have no nodes there")
def test_a_file_that_is_not_a_camera_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "video0"
    path.touch()
    assert DeviceOptions(gain=3).configure(str(path)) == ["the camera's gain can't be set"]
    assert "No such file" in DeviceOptions(exposure=3.0).configure(str(tmp_path / "gone"))[0]
    with v4l2.opened(str(path)) as device, pytest.raises(OSError, match="Inappropriate"):
        device.captures()
    assert DeviceOptions().configure(str(path)) == []


@only_on("linux", reason="cameras have no nodes there")
def test_a_listing_has_the_address_the_formats_and_the_settings(webcam: Webcam, tmp_path: Path) -> None:
    path = tmp_path / "video0"
    path.touch()
    lines = listed(CameraDevice(path, "HD Webcam", True), lambda _descriptor, *asked: webcam(7, *asked))
    assert lines[0] == f"video://{path} (HD Webcam)"
    assert "  format=mjpeg: 1280x720 at 30, 15; 640x480 at 29.97" in lines
    assert "  gain=0 to 255, now auto" in lines
    assert len(lines) == 7


@only_on("linux", reason="cameras have no nodes there")
def test_a_listing_of_an_unreadable_camera_says_why(webcam: Webcam, tmp_path: Path) -> None:
    assert listed(CameraDevice(tmp_path / "gone", "Webcam", True))[1] == "  can't be opened: No such file or directory"
    (tmp_path / "video0").touch()
    device = CameraDevice(tmp_path / "video0", "Webcam", True)
    assert listed(device)[1] == f"  can't be opened: {os.strerror(errno.ENOTTY)}"
    webcam.capabilities = 0, 0
    assert listed(device, lambda _descriptor, *asked: webcam(7, *asked))[1] == "  captures no images"


def test_cameras_of_other_systems_are_listed_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """With what PyAV returns there (its documentation), because FFmpeg for Linux has no such devices."""
    device = pytest.importorskip("av.device", reason="PyAV 17 or later lists devices")
    asked: list[str] = []

    def enumerate_input_devices(name: str) -> list[object]:
        asked.append(name)
        both = {"Integrated Camera": "video", "Microphone": "audio"}
        return [device.DeviceInfo(name, f"{name} (USB)", False, [kind]) for name, kind in both.items()]

    monkeypatch.setattr(device, "enumerate_input_devices", enumerate_input_devices)
    monkeypatch.setattr("sys.platform", "win32")
    (camera,) = v4l2.cameras()
    assert asked == ["dshow"]
    assert listed(camera) == ["video://dshow://Integrated Camera (Integrated Camera (USB))"]
    source = source_of(str(camera.path), "video://")
    assert (source.name, source.device, source.scheme) == ("video=Integrated Camera", "dshow", "")
    monkeypatch.undo()
    assert v4l2.other_cameras("avfoundation") == [], "this FFmpeg has no such devices"
    assert source_of("avfoundation://0", "video://").name == "0:none"
    with pytest.raises(UsageError, match="dshow://NAME"):
        source_of("dshow://", "video://")
