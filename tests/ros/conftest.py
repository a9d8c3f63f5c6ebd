"""An rclpy that keeps what is published."""

import pytest

from tests.ros.fake_rclpy import Fake, install


@pytest.fixture
def rclpy(monkeypatch: pytest.MonkeyPatch) -> Fake:
    return install(monkeypatch)
