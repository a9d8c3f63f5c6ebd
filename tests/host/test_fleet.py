"""The vehicle file of a host: its meaning, and its errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from skyloop.drivers.uri import parse_uri
from skyloop.errors import FileFormatError, UsageError
from skyloop.host.fleet import VehicleSettings, parse_fleet, read_fleet
from skyloop.messages import Value

ALPHA = '[[vehicle]]\nname = "alpha"\naddress = "sim://"\n'


def test_defaults_apply_where_nothing_else_is_set() -> None:
    fleet = parse_fleet(
        """
        name = "lab"
        [defaults]
        network = "multicast"
        keys = "keys/lab"
        limits = {speed = 1.0, tilt = 0.2}
        zones = ["cylinder 2 0 0.5 0 3"]
        parameters = {"failsafe.land_after_s" = 3, "failsafe.return" = true}
        process = "own"

        [[vehicle]]
        name = "alpha"
        address = "sim://?seed=1"

        [[vehicle]]
        name = "bravo"
        address = "sim://?seed=1"
        network = "off"
        limits = {speed = 2}
        zones = ["pillar: cylinder 1 0 0.5 0 3", "box 3 3 0 5 4 2"]
        autostart = false
        process = "shared"
        """,
        "fleet.toml",
    )
    presets: dict[str, Value] = {
        "limits.speed": 1.0,
        "limits.tilt": 0.2,
        "safety.zones": "cylinder 2 0 0.5 0 3",
        "failsafe.land_after_s": 3.0,
        "failsafe.return": True,
    }
    assert fleet.name == "lab"
    assert fleet.vehicles == (
        VehicleSettings(
            "alpha", parse_uri("sim://?seed=1"), network="multicast", keys="keys/lab", presets=presets, own_process=True
        ),
        VehicleSettings(
            "bravo",
            parse_uri("sim://?seed=1"),
            presets=presets | {"limits.speed": 2.0, "safety.zones": "pillar: cylinder 1 0 0.5 0 3; box 3 3 0 5 4 2"},
            autostart=False,
        ),
    )


def test_an_empty_file_is_a_host_to_add_vehicles_to() -> None:
    assert parse_fleet("", "fleet.toml").vehicles == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[vehicle]]\nname = 'a'\n", ["fleet.toml", "vehicle 'a'", "'address'", "missing"]),
        (ALPHA + "adress = 'x'", ["vehicle 'alpha'", "'adress'", "unknown key", "did you mean 'address'"]),
        ("[vehicle]\nname = 'a'", ["[[vehicle]]"]),
        ("nam = 'x'", ["'nam'", "did you mean 'name'"]),
        ("name = 'My Host'", ["key 'name'", "lower-case"]),
        (ALPHA + "process = 'owm'", ["'process'", "'owm'", "did you mean 'own'"]),
        (ALPHA + "autostart = 'yes'", ["'autostart'", "'yes'", "true or false"]),
        (ALPHA + "zones = 'box'", ["'zones'", "a list of strings"]),
        (ALPHA + "zones = ['bax 1']", ["vehicle 'alpha'", "'zones'", "bax"]),
        (ALPHA + "limits = {sped = 1.0}", ["vehicle 'alpha'.limits", "'sped'", "did you mean 'speed'"]),
        (ALPHA + "limits = {speed = 99.0}", ["vehicle 'alpha'.limits", "'speed'", "at most 30 m/s"]),
        (ALPHA + "limits = {speed = 'fast'}", ["'speed'", "'fast'", "finite number"]),
        (ALPHA + "limits = 3", ["'limits'", "a table"]),
        (ALPHA + "parameters = {'failsafe.land' = 1}", ["'failsafe.land'", "did you mean"]),
        (ALPHA + "parameters = {'failsafe.return' = 1}", ["alpha'.parameters", "'failsafe.return'", "bool"]),
        (ALPHA + "keys = 'k'", ["'keys'", 'network = "multicast"']),
        (ALPHA + "listen = ['10.0.0.1']", ["'listen'", 'network = "multicast"']),
        (ALPHA + ALPHA, ["vehicle 'alpha'", "two vehicles"]),
        (ALPHA.replace("alpha", "Alpha One"), ["'name'", "lower-case"]),
        (ALPHA.replace("sim://", "sym://"), ["'address'", "sym", "sim"]),
        (ALPHA.replace("sim://", "here"), ["'address'", "here"]),
        ("[defaults]\nlimits = {speed = -1}", ["[defaults.limits]", "'speed'", "at least 0.05 m/s"]),
        ("[defaults]\nname = 'x'", ["[defaults]", "'name'", "unknown key"]),
        (
            "".join(f'[[vehicle]]\nname = "{name}"\naddress = "tello://192.168.10.1"\n' for name in "ab"),
            ["vehicle 'b'", "'address'", "also the address of 'a'"],
        ),
        ("[[vehicle", ["not valid TOML"]),
    ],
)
def test_errors_name_the_place_and_valid_values(text: str, words: list[str]) -> None:
    with pytest.raises(FileFormatError) as error:
        parse_fleet(text, "fleet.toml")
    for word in ["fleet.toml", *words]:
        assert word in str(error.value)


def test_key_folders_are_relative_to_the_file(tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_text("[defaults]\nnetwork = 'multicast'\nkeys = 'lab'\n" + ALPHA)
    fleet = read_fleet(tmp_path / "fleet.toml")
    assert [vehicle.keys for vehicle in fleet.vehicles] == [str(tmp_path / "lab")]
    assert fleet.defaults.keys == str(tmp_path / "lab")


def test_an_unreadable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"fleet.toml can't be read"):
        read_fleet(tmp_path / "fleet.toml")
    (tmp_path / "fleet.toml").write_bytes(b"\xff")
    with pytest.raises(FileFormatError, match="not UTF-8"):
        read_fleet(tmp_path / "fleet.toml")
    (tmp_path / "fleet.toml").write_bytes(b"#" * (1 << 19))
    with pytest.raises(FileFormatError, match="more than"):
        read_fleet(tmp_path / "fleet.toml")
