"""Every notebook runs from top to bottom."""

from __future__ import annotations

from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))


SHOWN = {
    "paint_a_trait": (4, 1, "pixels changed beside the handle: 0"),
    "a_trait_of_your_own": (4, 0, "True None candy +"),
}
"""Pictures, live canvases, and a line that is printed."""


def test_there_are_notebooks() -> None:
    assert {path.stem for path in NOTEBOOKS} == set(SHOWN)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the Jupyter client's own warnings are not ours
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path: Path, tmp_path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    )
    client.execute()  # raises CellExecutionError with the cell's traceback
    shown = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    pictures, canvases, said = SHOWN[path.stem]
    assert sum("image/png" in o.get("data", {}) for o in shown) == pictures
    canvas = "application/vnd.jupyter.widget-view+json"
    assert sum(canvas in o.get("data", {}) for o in shown) == canvases
    printed = "".join(o.get("text", "") for o in shown)
    assert said in printed
