"""Fixtures of the cockpit's tests."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from skyloop.cockpit.fleet import CockpitFleet
from tests.cockpit.browser import Deck, browser_and_cockpit
from tests.support.cockpit import Node, Nodes, cockpit
from tests.support.testclient import TestClient

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture
def node() -> Iterator[Node]:
    """A proxy named alpha, with a flying vehicle."""
    node = Node()
    yield node
    node.stop()


@pytest.fixture
def client(node: Node) -> Iterator[TestClient]:
    """The cockpit of that proxy."""
    with cockpit(CockpitFleet(Nodes(node), search_s=0.05)) as client:
        yield client


@pytest.fixture(scope="module")
def open_cockpit(request: pytest.FixtureRequest) -> Iterator[tuple[Browser, str]]:
    """The browser and cockpit of one module's tests: Chromium, unless marked ``IN_FIREFOX`` or ``IN_BOTH``."""
    with browser_and_cockpit(getattr(request, "param", "chromium")) as opened:
        yield opened


@pytest.fixture
def deck(open_cockpit: tuple[Browser, str]) -> Iterator[Deck]:
    """That cockpit, with the pages and proxies of one test."""
    deck = Deck(*open_cockpit)
    yield deck
    deck.end()
