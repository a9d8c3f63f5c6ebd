"""Tests that fly a vehicle that somebody names: ``pytest tests/hardware --drone=mavlink://udpin:127.0.0.1:14540``.

The vehicle takes off, moves some metres and lands, twice. **Simulated, tied down or netted in, with nobody near.**
Without ``--drone`` they are skipped.
"""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--drone", default=None, help="address of the vehicle that tests/hardware flies")


@pytest.fixture(scope="session")
def address(request: pytest.FixtureRequest) -> str:
    """Of the vehicle to fly."""
    given = request.config.getoption("--drone", None)  # unknown where these tests are not named on the command line
    if not given:
        pytest.skip("no vehicle is named: --drone=ADDRESS")
    return str(given)
