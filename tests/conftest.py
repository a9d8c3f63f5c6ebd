"""Shared by all tests."""

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

# Property-based tests use the same examples in every run, so that results are reproducible. `make explore` searches for
# new ones for this many seconds; add its findings as @example. There are no deadlines, because the machine may be busy;
# the tests' time-out ends a test that hangs.
EXPLORE_S = float(os.environ.get("SKYLOOP_EXPLORE", "0"))
settings.register_profile("skyloop", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None, derandomize=False, print_blob=True)
settings.load_profile("explore" if EXPLORE_S else "skyloop")
_EXPLORING_ENDS_S = pytest.StashKey[float]()
_EXIT_STATUS = pytest.StashKey[int]()

# Must run before any test module imports them, so that a failing assertion in the public suites shows its values.
pytest.register_assert_rewrite("skyloop.transport.conformance", "skyloop.transport.testing", "skyloop.drivers.suite")

# A shell ignores SIGINT for its background jobs, and children inherit that: the commands that the tests start and
# interrupt would never receive it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Folders whose processes mostly fly. Measuring their coverage would slow the flights down and find nothing new.
FLIGHTS = {"benchmarks", "docs", "examples", "processes", "third_party", "test_bench.py", "test_demo.py"}

# Folders that `make test` leaves out: promises kept for minutes, under faults, or between several hosts.
SLOW = {"benchmarks", "faults", "fuzz", "hardware", "hosts", "security", "third_party"}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if EXPLORE_S:
        others = [item for item in items if not getattr(getattr(item, "obj", None), "is_hypothesis_test", False)]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if item not in set(others)]
        random.shuffle(items)  # because there is not enough time for all of them
    for item in items:
        parts = item.path.relative_to(TESTS).parts
        process = item.get_closest_marker("process") is not None
        if process and FLIGHTS.intersection(parts):
            item.add_marker("flight")
        if SLOW.intersection(parts) or (process and item.get_closest_marker("daily") is None):
            item.add_marker("slow")


def pytest_runtestloop(session: pytest.Session) -> None:
    if EXPLORE_S:  # counts from here, because collecting the tests takes a while
        session.config.stash[_EXPLORING_ENDS_S] = time.monotonic() + EXPLORE_S


def pytest_runtest_setup(item: pytest.Item) -> None:
    if EXPLORE_S and time.monotonic() > item.config.stash[_EXPLORING_ENDS_S]:
        pytest.skip("the time to explore is over")


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """Report threads that tests left behind, and exit: Python would wait for them forever.

    A test that fails before it closes its network session leaves such a thread.
    """
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
    """Use a separate state directory, so that the proxies of tests leave no traces in the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session", autouse=True)
def trusted_networks() -> Iterator[None]:
    """Load the tests' own ONNX files without first trying each in a child process, which tests/promises does."""
    with pytest.MonkeyPatch.context() as patch:
        if find_spec("onnxruntime"):
            patch.setattr("skyloop.vision.onnx.try_alone", lambda *files, tracker="": None)
        yield


@pytest.fixture(scope="session", autouse=True)
def traced() -> Iterator[None]:
    """Let coverage see the code that Zenoh calls on its own threads, which Python's tracing does not cover."""
    hook = threading.gettrace()
    if hook is None or not find_spec("skyloop.network"):
        yield
        return
    from skyloop.network.session import FabricSession

    plain = FabricSession.callback

    def callback(self: FabricSession, function: Callable[[Any], None]) -> Any:
        def call(argument: Any) -> None:
            if sys.gettrace() is None:
                sys.settrace(hook)
            function(argument)

        return plain(self, call)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FabricSession, "callback", callback)
        yield
