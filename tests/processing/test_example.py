"""``examples/detector_on_another_host.py``: its detector in a separate process, its controller in this one."""

from __future__ import annotations

import runpy
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

import skyloop
from skyloop.messages import Annotation
from tests.support.processes import Process

EXAMPLE = Path(__file__).parents[2] / "examples" / "detector_on_another_host.py"
pytestmark = pytest.mark.process


@pytest.fixture
def alpha(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A proxy and a worker of the detector."""
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        proxy = Process("-m", "skyloop", "proxy", "sim://?cameras=front", "--name", "alpha")
        worker = None
        try:
            proxy.until("ready")
            worker = Process("-m", "skyloop", "process", f"{EXAMPLE}:Detector", "--drone", "alpha")
            worker.until("detector front  part 1 of 1")
            yield "alpha"
        finally:
            for process in (worker, proxy):
                if process is not None:
                    process.end()


@pytest.mark.daily
def test_it_turns_by_the_results_of_another_process(alpha: str, capsys: pytest.CaptureFixture[str]) -> None:
    drawn: list[Annotation] = []
    yaws: list[float] = []
    with skyloop.connect(alpha, access="observe") as eye:
        eye.on_annotation(drawn.append)
        eye.on_feedback(lambda feedback: yaws.append(feedback.yaw_rad or 0.0))
        runpy.run_path(str(EXAMPLE), run_name="example")["main"](alpha, seconds=5.0)
        eye.wait(lambda feedback: feedback.state == "landed" and feedback.owner is None)
    assert " results (" in capsys.readouterr().out
    assert max(yaws) - min(yaws) > 0.3  # it turned
    assert {one.source for one in drawn} == {"detector"}


def test_it_is_short() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 60
