"""For all tests."""

import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

TESTS = Path(__file__).parent

# Properties are tested with the same examples each time, so that a person's run gives the same answer each time. New
# ones are looked for where somebody asks (make explore), for so many seconds: what that finds becomes an @example.
# A busy machine is no failure; what hangs is ended by the tests' time-out.
EXPLORE_S = float(os.environ.get("SKYLOOP_EXPLORE", "0"))
settings.register_profile("skyloop", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None, derandomize=False, print_blob=True)
settings.load_profile("explore" if EXPLORE_S else "skyloop")
_EXPLORING_ENDS_S = pytest.StashKey[float]()
_EXIT_STATUS = pytest.StashKey[int]()

# Before any test module imports them: a failing assertion of the public suites then shows its values.
pytest.register_assert_rewrite("skyloop.transport.conformance", "skyloop.transport.testing", "skyloop.drivers.suite")

# A shell ignores SIGINT for its background jobs, and children inherit that: the commands that the tests start and
# interrupt would never hear of it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Folders whose processes mostly fly. Measuring their coverage would slow flights down and find what others have found.
FLIGHTS = {"benchmarks", "docs", "examples", "processes", "third_party", "test_bench.py", "test_demo.py"}

# Folders of which `make test` leaves everything out: promises kept for minutes, under faults, or between several hosts.
SLOW = {"benchmarks", "faults", "fuzz", "hardware", "hosts", "security", "third_party"}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if EXPLORE_S:
        others = [item for item in items if not getattr(getattr(item, "obj", None), "is_hypothesis_test", False)]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if item not in set(others)]
        random.shuffle(items)  # the time is over before all had their turn
    for item in items:
        parts = item.path.relative_to(TESTS).parts
        process = item.get_closest_marker("process") is not None
        if process and FLIGHTS.intersection(parts):
            item.add_marker("flight")
        if SLOW.intersection(parts) or (process and item.get_closest_marker("daily") is None):
            item.add_marker("slow")


def pytest_runtestloop(session: pytest.Session) -> None:
    if EXPLORE_S:  # from here on: collecting the tests takes a while by itself
        session.config.stash[_EXPLORING_ENDS_S] = time.monotonic() + EXPLORE_S


def pytest_runtest_setup(item: pytest.Item) -> None:
    if EXPLORE_S and time.monotonic() > item.config.stash[_EXPLORING_ENDS_S]:
        pytest.skip("the time to explore is over")


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """A run whose tests left threads behind that Python would wait for says which, and ends: a test that failed before
    it closed its network session would let the run hang for ever."""
    left = [each for each in threading.enumerate() if each is not threading.main_thread() and not each.daemon]
    for each in left:
        each.join(1.0)
    names = sorted(each.name for each in left if each.is_alive())
    if names:
        print(f"ENDED with threads left behind: {', '.join(names[:10])}", file=sys.stderr, flush=True)
        os._exit(int(config.stash.get(_EXIT_STATUS, 1)))


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    session.config.stash[_EXIT_STATUS] = exitstatus


@pytest.fixture(scope="session", autouse=True)
def state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A user's directory of state for the tests alone: what proxies write there is nobody's flight."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session", autouse=True)
def trusted_networks() -> Iterator[None]:
    """Load the tests' own ONNX files without a child process that tries each first; tests/promises tries them."""
    with pytest.MonkeyPatch.context() as patch:
        if find_spec("onnxruntime"):
            patch.setattr("skyloop.vision.onnx.try_alone", lambda *files, tracker="": None)
        yield


@pytest.fixture(scope="session", autouse=True)
def traced() -> Iterator[None]:
    """Let coverage see what Zenoh calls on threads of its own, which Python's tracing does not reach by itself."""
    hook = threading.gettrace()
    if hook is None:
        yield
        return
    from skyloop.network.session import Session

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
