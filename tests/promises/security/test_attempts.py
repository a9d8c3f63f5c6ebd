"""Attempts with Zenoh's plain API: what each key permits. ``docs/security.md`` shows the outcomes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skyloop.transport.testing import wait_until
from tests.promises.security.deeds import COLUMNS, DEEDS, Deed, comes_true, works
from tests.promises.security.rig import Intruder, Rig, keys_of, make_lab


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A lab with keys, one of which (eve's) was revoked later."""
    directory = tmp_path_factory.mktemp("keys")
    lab = make_lab(directory / "lab")
    eve = keys_of(lab, "eve", directory)
    lab.revoke("eve")
    return lambda name: eve if name == "eve" else lab.folder(name)


@pytest.fixture(scope="module")
def secured(keys: Callable[[str], Path]) -> Iterator[Rig]:
    with Rig(keys) as rig:
        yield rig


@pytest.fixture
def rig(request: pytest.FixtureRequest, keys: Callable[[str], Path]) -> Iterator[Rig]:
    """A rig shared by all attempts without effect, or a new one for an attempt that works."""
    deed, who = request.node.callspec.params["deed"], request.node.callspec.params["who"]
    if who != "nobody" and not works(deed, who):
        yield request.getfixturevalue("secured")
        return
    with Rig(None if who == "nobody" else keys) as own:
        yield own


@pytest.fixture
def intruder(rig: Rig, who: str) -> Iterator[Intruder]:
    somebody = rig.intruder(who)
    yield somebody
    somebody.close()


@pytest.mark.parametrize("who", COLUMNS)
@pytest.mark.parametrize("deed", DEEDS, ids=lambda deed: deed.what.replace(" ", "-"))
def test_an_attempt(deed: Deed, who: str, rig: Rig, intruder: Intruder) -> None:
    if works(deed, who):

        def tried() -> bool:  # repeated, as datagrams may be lost and subscriptions take a moment to be known
            deed.do(rig, intruder)
            return comes_true(lambda: deed.done(rig, intruder), 0.5)

        wait_until(tried, f"{deed.what} works")
        return
    deed.do(rig, intruder)
    deed.do(rig, intruder)
    assert not comes_true(lambda: deed.done(rig, intruder), 0.05)
    rig.jane.sync()
    rig.wendy.sync()
    assert not deed.done(rig, intruder)
