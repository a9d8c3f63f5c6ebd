from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.proxy_bench import Bench


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as bench:
        yield bench
