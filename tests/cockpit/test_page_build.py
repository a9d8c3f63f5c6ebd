"""The committed page matches its sources: see cockpit-page/build.mjs."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from skyloop.cockpit.app import STATIC

PAGE = Path(__file__).parents[2] / "cockpit-page"
SETTINGS = ("build.mjs", "package.json", "package-lock.json", "tsconfig.json")
MOST_BYTES = 1_000_000


def hash_of(folder: Path) -> str:
    """Hash like the build: over name, NUL, content, NUL of each file, by name."""
    found = [path for part in ("src", "public") for path in (folder / part).rglob("*") if path.is_file()]
    named = {path.relative_to(folder).as_posix(): path for path in [*found, *(folder / name for name in SETTINGS)]}
    total = hashlib.sha256()
    for name in sorted(named):
        total.update(name.encode() + b"\0" + named[name].read_bytes() + b"\0")
    return total.hexdigest()


def test_the_build_is_of_these_sources() -> None:
    if not PAGE.is_dir():
        pytest.skip("without the page's sources")
    manifest = json.loads((STATIC / "manifest.json").read_text())
    assert manifest["sources"] == hash_of(PAGE), "the page's sources have changed: make page"


def test_the_built_files_are_unmodified() -> None:
    manifest = json.loads((STATIC / "manifest.json").read_text())
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*") if path.is_file()}
    assert set(files) - {"manifest.json"} == set(manifest["files"])
    for name, wanted in manifest["files"].items():
        assert hashlib.sha256(files[name].read_bytes()).hexdigest() == wanted, (
            f"{name} is not as it was built: make page"
        )
    assert sum(path.stat().st_size for path in files.values()) < MOST_BYTES


def test_the_page_loads_nothing_from_other_hosts() -> None:
    page = (STATIC / "index.html").read_text()
    assert "http" not in page
    assert "style=" not in page
    assert page.count("<script") == 1, "and none within the page: its policy forbids that"
