"""Addresses of AR.Drones."""

from __future__ import annotations

import pytest

from skyloop.drivers.registry import make_driver
from skyloop.drivers.uri import parse_uri
from skyloop.errors import DriverError, ParameterError, UsageError
from skyloop.messages import Hover
from skyloop.vehicles.ardrone.driver import ACTIONS, ArdroneDriver
from skyloop.vehicles.ardrone.options import ArdroneOptions, options_of
from skyloop.vehicles.ardrone.wire.navdata import Ports


def test_the_usual_address() -> None:
    assert options_of(parse_uri("ardrone://192.168.1.1")) == ArdroneOptions(
        "192.168.1.1", Ports(5554, 5555, 5556, 5559)
    )


def test_all_options() -> None:
    address = (
        "ardrone://my-drone.local?version=1&navdata=full&navdata_options=altitude,wifi&rate=20&video=0&ids=no"
        "&navdata_port=1&video_port=2&at_port=3&control_port=4&fx=500"
    )
    assert options_of(parse_uri(address)) == ArdroneOptions(
        host="my-drone.local",
        ports=Ports(1, 2, 3, 4),
        version=1,
        full=True,
        navdata_options=1 | 1 << 10 | 1 << 26,
        rate_hz=20.0,
        video=False,
        ids=False,
    )


@pytest.mark.parametrize(("text", "mask"), [("0x10000", 0x10001), ("65537", 65537), ("demo", 1), ("0", 1)])
def test_options_of_navdata(text: str, mask: int) -> None:
    assert options_of(parse_uri(f"ardrone://d?navdata_options={text}")).navdata_options == mask


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("ardrone://", "look like ardrone://192.168.1.1"),
        ("ardrone://192.168.1.1:5556", "at_port=5556"),
        ("ardrone://a b", "not the name or IPv4 address"),
        ("ardrone:///dev/video0", "not the name or IPv4 address"),
        ("ardrone://d?version=3", "auto"),
        ("ardrone://d?navdata=most", "no navdata"),
        ("ardrone://d?navdata_options=altitudes", "did you mean 'altitude'"),
        ("ardrone://d?navdata_options=0xffffffff1", "no option of navdata"),
        ("ardrone://d?navdata_options=9999999999", "32 bits"),
        ("ardrone://d?at_port=0", "at_port"),
        ("ardrone://d?at_port=70000", "65535"),
        ("ardrone://d?at_port=5.5", "whole number"),
        ("ardrone://d?rate=0", "rate"),
        ("ardrone://d?vidoe=0", "did you mean 'video'"),
        ("ardrone://d?video=perhaps", "true or false"),
        ("ardrone://d?cx=10", "needs fx"),
        ("ardrone://d?fx=500&distortion=1,2", "distortion"),
    ],
)
def test_invalid_addresses(address: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        options_of(parse_uri(address))


def test_capabilities_need_no_drone() -> None:
    driver = make_driver("ardrone://192.168.1.1?fx=500")
    capabilities = driver.capabilities()
    assert (capabilities.vehicle, capabilities.actions) == ("ardrone", ACTIONS)
    front, bottom = capabilities.cameras
    assert (front.name, front.width, front.height, bottom.name) == ("front", 640, 360, "bottom")
    assert front.intrinsics is not None
    assert (front.intrinsics.fx, front.intrinsics.cx) == (500.0, 319.5)
    assert bottom.intrinsics is not None
    assert bottom.intrinsics.fx == pytest.approx(687.0, abs=1.0)


def test_capabilities_of_an_ardrone_1_and_without_video() -> None:
    one = make_driver("ardrone://192.168.1.1?version=1").capabilities()
    assert one.vehicle == "ardrone1"
    assert [(camera.width, camera.height) for camera in one.cameras] == [(320, 240), (176, 144)]
    assert [camera.intrinsics for camera in one.cameras] == [None, None]
    assert make_driver("ardrone://192.168.1.1?version=2&video=0").capabilities().cameras == ()


def test_an_unopened_driver() -> None:
    driver = ArdroneDriver(parse_uri("ardrone://192.168.1.1"))
    assert driver.parameters() == []
    with pytest.raises(ParameterError, match="not open"):
        driver.set_parameter("limits.tilt", 0.1)
    with pytest.raises(DriverError, match="not open"):
        driver.apply(Hover())
    assert driver.failsafe(Hover()) is False
    driver.close()
