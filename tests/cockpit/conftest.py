"""Fixtures of the cockpit's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from skyloop.cockpit.fleet import Fleet
from tests.cockpit.fake import Node, Nodes, cockpit
from tests.cockpit.testclient import TestClient


@pytest.fixture
def node() -> Iterator[Node]:
    """A proxy named alpha, with a vehicle that flies."""
    node = Node()
    yield node
    node.stop()


@pytest.fixture
def client(node: Node) -> Iterator[TestClient]:
    """The cockpit of that proxy."""
    with cockpit(Fleet(Nodes(node), look_s=0.05)) as client:
        yield client
