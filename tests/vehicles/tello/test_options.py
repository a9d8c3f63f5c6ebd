"""Valid and invalid ``tello://`` addresses."""

from __future__ import annotations

import pytest

from skyloop.drivers.uri import parse_uri
from skyloop.errors import UsageError
from skyloop.vehicles.tello.driver import TelloDriver
from skyloop.vehicles.tello.options import TelloOptions, VelocityAxes, options_of


def test_an_address_without_options() -> None:
    assert options_of(parse_uri("tello://192.168.10.1")) == TelloOptions("192.168.10.1")


def test_all_options() -> None:
    made = options_of(
        parse_uri(
            "tello://tello.local?local=192.168.1.101&interface=wlan1&port=9000&state_port=8891&video_port=11112"
            "&video=0&concealed=2&pads=1&velocity_axes=body"
        )
    )
    assert made == TelloOptions(
        "tello.local", "192.168.1.101", "wlan1", 9000, 8891, 11112, False, 2, True, VelocityAxes.BODY
    )
    assert made.own_ports
    assert not TelloOptions("d").own_ports


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("tello://", "names no host"),
        ("tello://192.168.10.1:8889", r"the port is given as an option: \?port=8889"),
        ("tello://a b", "is not the name or IPv4 address"),
        ("tello://d?locale=1.2.3.4", "did you mean 'local'"),
        ("tello://d?local=wlan1", "an interface is named by interface="),
        ("tello://d?interface=../x", "must be the name of a network interface"),
        ("tello://d?velocity_axes=bdy", "did you mean 'body'"),
        ("tello://d?state_port=80", "from 1025 to 65535"),
        ("tello://d?state_port=9000&video_port=9000", "can't share port 9000"),
        ("tello://d?cx=10", "needs fx"),
        ("tello://d?concealed=31", "from 0 to 30"),
    ],
)
def test_invalid_addresses_are_refused(address: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        TelloDriver(parse_uri(address))


def test_intrinsics_of_the_address_are_the_front_cameras() -> None:
    front, bottom = TelloDriver(parse_uri("tello://d?fx=900&cx=480&cy=360")).capabilities().cameras
    assert front.intrinsics is not None
    assert (front.intrinsics.fx, front.intrinsics.cx) == (900, 480)
    assert bottom.intrinsics is None
    assert TelloDriver(parse_uri("tello://d?video=0")).capabilities().cameras == ()
