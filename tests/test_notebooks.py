"""Every notebook runs from top to bottom, in a folder of its own."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"
TIME_LIMIT = 240  # s for one cell, on two slow cores
FOUND = sorted(path for path in NOTEBOOKS.iterdir() if path.suffix in {".py", ".ipynb"})


def test_there_are_notebooks():
    assert FOUND, f"no notebook in {NOTEBOOKS}"


def test_no_notebook_stands_there_twice():
    """A percent script and an .ipynb of the same name would drift apart."""
    names = [path.stem for path in FOUND]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_notebook_holds_no_output(path):
    """Pictures and numbers come from running it, here and at the reader's."""
    notebook = jupytext.read(path)
    stale = [k for k, cell in enumerate(notebook.cells) if cell.cell_type == "code" and cell.get("outputs")]
    assert not stale, f"clear the outputs of cells {stale}"


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_notebook_explains_itself(path):
    """It opens with a title, and words stand between the code."""
    cells = jupytext.read(path).cells
    assert cells, "the notebook is empty"
    assert cells[0].cell_type == "markdown"
    assert cells[0].source.startswith("# ")
    assert sum(cell.cell_type == "markdown" for cell in cells) >= 3


@pytest.mark.notebook
@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_notebook_runs(path, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    # the kernel must import the very package under test, wherever it is started
    root = str(NOTEBOOKS.parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])))
    notebook = jupytext.read(path)
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    with warnings.catch_warnings():
        # jupyter_client, pyzmq and asyncio warn about each other's deprecations
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", ResourceWarning)
        client = NotebookClient(
            notebook,
            timeout=TIME_LIMIT,
            kernel_name="python3",
            resources={"metadata": {"path": str(tmp_path)}},
        )
        client.execute()
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]
    assert all(cell.execution_count for cell in code), "a cell was not executed"
    shown = [output for cell in code for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in shown), "no picture was drawn"
    complaints = [
        output["text"]
        for output in shown
        if output.output_type == "stream" and output.name == "stderr" and "Warning" in output["text"]
    ]
    assert not complaints, f"warnings in the notebook: {complaints}"
