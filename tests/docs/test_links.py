"""Links and files named on the pages exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from skyloop.cli.naming import keys_directory
from tests.support.pages import PAGES, ROOT, prose, spans

MOST_BYTES = 300_000
LARGE = {"cockpit-follow.webp": 700_000}  # a film of the page, whose text has to be read
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def links(page: Path) -> list[str]:
    return [target for target in _LINK.findall(prose(page)) if not re.match(r"\w+:", target)]


def anchors(page: Path) -> set[str]:
    """As GitHub makes them of headings."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_within_the_repository_resolve(page: Path) -> None:
    for target in links(page):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} points to {target}"
        assert file.is_relative_to(ROOT)
        assert not anchor or anchor in anchors(file), f"{page.name} points to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_files_exist(page: Path) -> None:
    for span in spans(page):
        for named in re.findall(r"(?:^|\s)((?:docs|src|tests|scripts)/[\w./-]*)(?=\s|$)", span):
            assert (ROOT / named).exists(), f"{page.name} names {named}"


def test_the_folder_of_keys_is_where_keys_makes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/anna")
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    folder = str(keys_directory()).replace("/home/anna", "~")
    named = {path for page in PAGES for path in re.findall(r"~/\.config/skyloop/[\w./-]*", page.read_text())}
    assert named
    assert [path for path in named if not path.startswith(folder)] == []


def test_pictures_are_small_and_all_are_shown() -> None:
    shown = {(page.parent / target).resolve() for page in PAGES for target in links(page)}
    pictures = [path for path in (ROOT / "docs" / "pictures").rglob("*") if path.is_file()]
    assert pictures
    for picture in pictures:
        assert picture in shown, f"{picture.name} is shown nowhere"
        assert picture.stat().st_size < LARGE.get(picture.name, MOST_BYTES), picture.name
