"""A driver outside the package, found by its entry point, keeps the contract, and the page shows its code."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.registry import known_schemes, make_driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import VehicleUri

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "tests" / "example_driver"


def install(project: Path, site: Path) -> None:
    """Write a project's metadata as an installer would, so that its entry points are found."""
    metadata = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    folder = site / f"{metadata['name'].replace('-', '_')}-{metadata['version']}.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {metadata['name']}\nVersion: {metadata['version']}\n"
    )
    lines = []
    for group, entries in metadata["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    (folder / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module", autouse=True)
def toy_installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    site = tmp_path_factory.mktemp("site")
    install(EXAMPLE, site)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE))
        patch.syspath_prepend(str(site))
        yield
        sys.modules.pop("skyloop_toy", None)


class TestToy(DriverSuite):
    uri = "toy://?speed=2"
    speed = 1.5
    climb = 1.5
    yaw_rate = 2.0

    def make(self, uri: VehicleUri) -> Driver:
        driver = super().make(uri)
        assert type(driver).__module__ == "skyloop_toy"
        return driver


def test_the_example_is_found_beside_our_own() -> None:
    assert {"sim", "toy", "video"} <= set(known_schemes())


def test_the_example_is_imported_on_first_use() -> None:
    sys.modules.pop("skyloop_toy", None)
    assert "toy" in known_schemes()
    assert "skyloop_toy" not in sys.modules
    make_driver("toy://")
    assert "skyloop_toy" in sys.modules


def test_the_page_shows_its_code() -> None:
    page = (ROOT / "docs" / "drivers.md").read_text()
    blocks = re.findall(r"```(?:python|toml)\n(.*?)```", page, re.DOTALL)
    assert (EXAMPLE / "skyloop_toy.py").read_text() in blocks
    assert (EXAMPLE / "pyproject.toml").read_text() in blocks
