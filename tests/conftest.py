"""For all tests."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

TESTS = Path(__file__).parent

# A busy machine is no failure; what hangs is ended by the tests' time-out.
settings.register_profile("skyloop", deadline=None)
settings.load_profile("skyloop")

# Before any test module imports them: a failing assertion of the public suites then shows its values.
pytest.register_assert_rewrite("skyloop.transport.conformance", "skyloop.transport.testing", "skyloop.drivers.suite")

# A shell ignores SIGINT for its background jobs, and children inherit that: the commands that the tests start and
# interrupt would never hear of it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Folders whose processes mostly fly. Measuring their coverage would slow flights down and find what others have found.
FLIGHTS = {"bench", "docs", "examples", "processes", "test_demo.py", "third_party"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("process") and FLIGHTS.intersection(item.path.relative_to(TESTS).parts):
            item.add_marker("flight")


@pytest.fixture(scope="session", autouse=True)
def state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A user's directory of state for the tests alone: what proxies write there is nobody's flight."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session", autouse=True)
def traced() -> Iterator[None]:
    """Let coverage see what Zenoh calls on threads of its own, which Python's tracing does not reach by itself."""
    hook = threading.gettrace()
    if hook is None:
        yield
        return
    from skyloop.transport.fabric.session import Session

    plain = Session.callback

    def callback(self: Session, function: Callable[[Any], None]) -> Any:
        def call(argument: Any) -> None:
            if sys.gettrace() is None:
                sys.settrace(hook)
            function(argument)

        return plain(self, call)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Session, "callback", callback)
        yield
