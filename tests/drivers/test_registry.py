"""Drivers are found by entry point, and errors name the package at fault."""

from __future__ import annotations

from importlib.metadata import EntryPoints, entry_points
from pathlib import Path

import pytest

from skyloop.drivers.registry import driver_class, known_schemes, make_driver
from skyloop.errors import DriverError, MissingExtraError, UnknownNameError, UsageError


def install(site: Path, package: str, entries: str) -> None:
    folder = site / f"{package}-1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(f"[skyloop.drivers]\n{entries}\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_our_own_drivers_are_known() -> None:
    assert {"sim", "video"} <= set(known_schemes())


def test_drivers_of_one_scheme_are_looked_up_once(monkeypatch: pytest.MonkeyPatch, site: Path) -> None:
    """A fleet of 2,000 vehicles took 56 s to read."""
    calls: list[str] = []

    def counted(*, group: str) -> EntryPoints:
        calls.append(group)
        return entry_points(group=group)

    monkeypatch.setattr("skyloop.drivers.registry.entry_points", counted)
    assert len({type(make_driver(f"mavlink://udpin:127.0.0.1:{port}")) for port in range(20_000, 20_020)}) == 1
    assert len(calls) == 1
    install(site, "later_drone", "laterdrone = skyloop.vehicles.sim.driver:SimDriver")
    assert driver_class("laterdrone") is driver_class("sim"), "a newly installed driver is found"


def test_an_unknown_scheme_gets_suggestions() -> None:
    with pytest.raises(UnknownNameError, match="no vehicle driver named 'vidoe'; did you mean 'video'") as caught:
        make_driver("vidoe:///tmp/x.mp4")
    assert caught.value.suggestions[0] == "video"


def test_an_invalid_address_is_refused() -> None:
    with pytest.raises(UsageError, match="is not a vehicle's address"):
        make_driver("kitchen")


def test_an_import_that_fails_names_package_and_cause(site: Path) -> None:
    install(site, "broken_drone", "brokendrone = broken_drone_module:Driver")
    (site / "broken_drone_module.py").write_text("import no_such_library_anywhere\n")
    with pytest.raises(DriverError, match=r"broken_drone .*no_such_library_anywhere") as caught:
        driver_class("brokendrone")
    assert isinstance(caught.value.__cause__, ImportError)


def test_an_attribute_that_is_missing_names_package_and_cause(site: Path) -> None:
    install(site, "half_drone", "halfdrone = half_drone_module:Driver")
    (site / "half_drone_module.py").write_text("")
    with pytest.raises(DriverError, match=r"half_drone .*Driver"):
        driver_class("halfdrone")


def test_a_class_that_is_not_a_driver_is_refused(site: Path) -> None:
    install(site, "not_a_drone", "notadrone = collections:OrderedDict")
    with pytest.raises(DriverError, match=r"not_a_drone .*is not a subclass of"):
        driver_class("notadrone")


def test_a_missing_extra_is_reported_as_such(site: Path) -> None:
    install(site, "extra_drone", "extradrone = extra_drone_module:Driver")
    (site / "extra_drone_module.py").write_text(
        "from skyloop.errors import MissingExtraError\nraise MissingExtraError('extradrone://', 'extradrone')\n"
    )
    with pytest.raises(MissingExtraError, match=r"skyloop install extradrone"):
        driver_class("extradrone")


def test_a_scheme_claimed_twice_names_both(site: Path) -> None:
    install(site, "first_drone", "contested = first_module:Driver")
    install(site, "second_drone", "contested = second_module:Driver")
    with pytest.raises(DriverError, match=r"contested:// is claimed by package first_drone .* second_drone"):
        driver_class("contested")


def test_one_package_found_through_two_folders_is_not_a_conflict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("one", "two"):
        install(tmp_path / folder, "same_drone", "samedrone = same_module:SameDriver")
        monkeypatch.syspath_prepend(str(tmp_path / folder))
    (tmp_path / "one" / "same_module.py").write_text(
        "from skyloop.vehicles.video.driver import VideoDriver as SameDriver\n"
    )
    assert driver_class("samedrone").__name__ == "VideoDriver"
