"""The notebook, run from first to last cell by a Jupyter kernel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.support.processes import sockets

__all__ = ["sockets"]  # a fixture

NOTEBOOK = Path(__file__).parents[2] / "examples" / "first_flight.ipynb"
HOW = "pip install nbclient ipykernel"
nbformat = pytest.importorskip("nbformat", reason=f"needs nbformat: {HOW}")
LONGEST_CELL_S = 60


@pytest.fixture
def notebook() -> Any:
    return nbformat.read(NOTEBOOK, as_version=4)


def outputs(notebook: Any, kind: str) -> list[Any]:
    return [output for cell in notebook.cells for output in cell.get("outputs", ()) if output.output_type == kind]


def test_it_is_committed_without_outputs(notebook: Any) -> None:
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert code
    assert all(not cell.outputs and cell.execution_count is None for cell in code)


@pytest.mark.process
@pytest.mark.filterwarnings("default")  # of Jupyter's own packages
def test_every_cell_runs(notebook: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client = pytest.importorskip("nbclient", reason=f"needs nbclient: {HOW}")
    pytest.importorskip("ipykernel", reason=f"needs ipykernel: {HOW}")
    pytest.importorskip("matplotlib", reason="needs matplotlib: skyloop install bench")
    for name in ("JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "IPYTHONDIR", "MPLCONFIGDIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    runner = client.NotebookClient(
        notebook, timeout=LONGEST_CELL_S, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    runner.execute()
    said = "".join(output.text for output in outputs(notebook, "stream"))
    assert " m, battery 100%" in said
    assert said.rstrip().endswith("landed")
    for kind, what in (("execute_result", "the frame, as it shows itself"), ("display_data", "a plot")):
        pictures = [output for output in outputs(notebook, kind) if "image/png" in output.data]
        assert len(pictures) == 1, what
