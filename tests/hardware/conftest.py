"""Tests that fly a vehicle of your choice: ``pytest tests/hardware --drone=mavlink://udpin:127.0.0.1:14540``.

The vehicle takes off, moves some metres and lands, twice. **It must be simulated, tethered or in a net, with no person
near.** Without ``--drone`` the tests are skipped.
"""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--drone", default=None, help="address of the vehicle that tests/hardware flies")


@pytest.fixture(scope="session")
def address(request: pytest.FixtureRequest) -> str:
    """Return the address of the vehicle to fly."""
    given = request.config.getoption("--drone", None)  # unknown unless pytest was given this folder
    if not given:
        pytest.skip("no vehicle is named: --drone=ADDRESS")
    return str(given)
