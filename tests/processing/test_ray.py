"""Processors on a Ray cluster: for real where Ray is installed, and otherwise against a fake Ray."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import skyloop.ray
from skyloop.errors import LinkError, MissingExtraError, NoAnswerError, UnknownNameError, UsageError
from skyloop.processing import Settings, Status
from tests.support.processes import Process

ROOT = Path(__file__).parents[2]
OWN = ROOT / ".third-party" / "ray" / "bin" / "python"  #: Ray in its own environment, because it is large
TARGET = f"{ROOT / 'tests' / 'integration' / 'processes' / 'processor.py'}:Marks"


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield Path(folder)


# With Ray ------------------------------------------------------------------------------------------------------


def with_ray() -> str:
    """The path of a Python with Ray."""
    if importlib.util.find_spec("ray") is not None:
        return sys.executable
    if not OWN.exists():
        pytest.skip("Ray is not installed: python -m venv .third-party/ray, and pip install '.[sim,ray]' there")
    return str(OWN)


@pytest.mark.process
def test_actors_share_the_frames_and_a_dead_one_is_restarted(sockets: Path) -> None:
    python = with_ray()
    proxy = Process("-m", "skyloop", "proxy", "sim://?world=empty&cameras=front&fps=20", "--name", "alpha")
    try:
        proxy.until("ready")
        environment = {
            **os.environ,
            "PYTHONPATH": str(ROOT / "src"),
            "RAY_TMPDIR": str(sockets),
            "RAY_AUTH_MODE": "disabled",
            "RAY_USAGE_STATS_ENABLED": "0",
        }
        command = [python, str(Path(__file__).with_name("ray_workers.py")), TARGET]
        done = subprocess.run(command, capture_output=True, text=True, timeout=110, env=environment, check=False)
    finally:
        proxy.end()
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    line = next(line for line in done.stdout.splitlines() if line.startswith("FOUND "))
    found = json.loads(line.removeprefix("FOUND "))
    print(found)
    assert len(found["before"]) == 2
    assert found["parts"] == [2, 2]
    assert len(set(found["before"]) & set(found["after"])) == 1  # the other one continued
    assert "runs other code under the name marks" in found["other"]


# Without it ----------------------------------------------------------------------------------------------------


class Actor:
    """Ray's handle of an actor that lives in this process."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.actor = make()
        self.status = SimpleNamespace(remote=lambda: self.actor.status)


class FakeRay(ModuleType):
    """The used part of Ray, with actors in this process; ``lost`` of them do not answer."""

    def __init__(self) -> None:
        super().__init__("ray")
        self.lost = 0
        self.options: dict[str, Any] = {}
        self.inits: list[dict[str, Any]] = []
        self.killed: list[Any] = []
        self.exceptions = SimpleNamespace(GetTimeoutError=TimeoutError, RayActorError=ConnectionError)
        self.cloudpickle = SimpleNamespace(register_pickle_by_value=lambda module: None)

    def is_initialized(self) -> bool:
        return bool(self.inits)

    def init(self, **options: Any) -> None:
        self.inits.append(options)

    def remote(self, kind: type[Any]) -> Any:
        def options(**given: Any) -> Any:
            self.options = given
            return SimpleNamespace(remote=lambda *order: Actor(lambda: kind(*order)))

        return SimpleNamespace(options=options)

    def wait(self, references: list[Any], *, num_returns: int, timeout: float) -> None: ...

    def get(self, reference: Callable[[], Any], timeout: float) -> Any:
        if self.lost:
            self.lost -= 1
            raise ConnectionError
        return reference()

    def kill(self, actor: Any, *, no_restart: bool) -> None:
        assert no_restart
        self.killed.append(actor)


class FakeWorker:
    """A worker that only reports its status."""

    def __init__(self, drone: Any, processor: Any, settings: Settings, tell: Any) -> None:
        self.status = Status(processor=settings.name, camera="front")

    def run(self, seconds: float) -> None: ...


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    fake = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setattr("skyloop.client.connect", lambda *_, **__: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(skyloop.ray, "Worker", FakeWorker)
    return fake


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install ray"):
        skyloop.ray.process(TARGET, drone="alpha")


def test_requests_to_ray(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", "/run/somewhere")
    with skyloop.ray.process(TARGET, drone="alpha", workers=2, name="mine", num_gpus=0.5) as workers:
        assert [status.processor for status in workers.statuses() if status is not None] == ["mine", "mine"]
        assert len(ray.inits) == 1
        assert ray.options["num_gpus"] == 0.5
        assert ray.options["max_restarts"] == -1
        assert ray.options["runtime_env"]["env_vars"]["SKYLOOP_RUNTIME_DIR"] == "/run/somewhere"
        ray.lost = 1
        assert [status is None for status in workers.statuses()] == [True, False]
    assert len(ray.killed) == 2
    workers.stop()
    assert len(ray.killed) == 2


def test_a_class_can_be_given_directly(ray: FakeRay) -> None:
    class Here:
        def process(self, frame: Any) -> int:
            return 1

    with skyloop.ray.process(Here, drone="alpha") as workers:
        [status] = workers.statuses()
        assert status is not None
        assert status.processor == "here"


def test_an_actor_that_cannot_start_is_reported(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(*_: Any, **__: Any) -> None:
        raise UnknownNameError("proxy", "alpha", [])

    monkeypatch.setattr("skyloop.client.connect", nowhere)
    with pytest.raises(LinkError, match="a worker has ended: no proxy named 'alpha'"):
        skyloop.ray.process(TARGET, drone="alpha", workers=2)
    assert len(ray.killed) == 2

    class Broken:
        def __init__(self) -> None:
            raise ValueError("no model")

        def process(self, frame: Any) -> None: ...

    with pytest.raises(LinkError, match=r"Broken\(\) raised ValueError\('no model'\)"):
        skyloop.ray.process(Broken, drone="alpha")


def test_a_worker_refused_later_is_reported(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    workers = skyloop.ray.process(TARGET, drone="alpha")
    actor = workers.actors[0].actor
    monkeypatch.setattr(actor._worker, "run", lambda seconds: (_ for _ in ()).throw(LinkError("somebody else")))
    actor._run(actor._worker)
    with pytest.raises(LinkError, match="somebody else"):
        workers.statuses()


def test_no_room_for_the_actors(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skyloop.ray, "_START_S", 0.05)
    monkeypatch.setattr(skyloop.ray, "_CHECK_S", 0.01)
    ray.lost = 1000
    with pytest.raises(NoAnswerError, match="did not start 3 actors"):
        skyloop.ray.process(TARGET, drone="alpha", workers=3)
    assert len(ray.killed) == 3


@pytest.mark.parametrize("workers", [0, 1.5])
def test_invalid_numbers_of_workers(ray: FakeRay, workers: Any) -> None:
    with pytest.raises(UsageError, match="must be at least 1"):
        skyloop.ray.process(TARGET, drone="alpha", workers=workers)


def test_any_other_error_of_a_workers_thread_is_reported(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    workers = skyloop.ray.process(TARGET, drone="alpha")
    actor = workers.actors[0].actor
    for error in (RuntimeError("no memory"), SystemExit(3)):
        monkeypatch.setattr(actor._worker, "run", lambda seconds, error=error: (_ for _ in ()).throw(error))
        actor._run(actor._worker)
        with pytest.raises(LinkError, match=f"its thread raised {type(error).__name__}"):
            workers.statuses()


def test_a_users_environment_is_kept_beside_ours(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", "/run/somewhere")
    monkeypatch.setenv("SKYLOOP_GROUP", "lab")
    wanted = {"pip": ["torch"], "env_vars": {"MODEL": "large", "SKYLOOP_GROUP": "other"}}
    skyloop.ray.process(TARGET, drone="alpha", runtime_env=wanted)
    found = ray.options["runtime_env"]
    assert found["pip"] == ["torch"]
    assert found["env_vars"]["SKYLOOP_RUNTIME_DIR"] == "/run/somewhere"
    assert found["env_vars"]["MODEL"] == "large"
    assert found["env_vars"]["SKYLOOP_GROUP"] == "other"
    assert wanted == {"pip": ["torch"], "env_vars": {"MODEL": "large", "SKYLOOP_GROUP": "other"}}
    skyloop.ray.process(TARGET, drone="alpha", runtime_env=None)
    assert ray.options["runtime_env"]["env_vars"]["SKYLOOP_GROUP"] == "lab"


@pytest.mark.parametrize("wrong", ["torch", {"env_vars": ["MODEL"]}])
def test_an_invalid_environment_is_refused(ray: FakeRay, wrong: Any) -> None:
    with pytest.raises(UsageError, match=r"runtime_env is .* must be a dict"):
        skyloop.ray.process(TARGET, drone="alpha", runtime_env=wrong)
