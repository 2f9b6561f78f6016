"""Every notebook runs from top to bottom, and stands beside its script with what it showed."""

from __future__ import annotations

import importlib.util
import os
import shutil
import warnings
from pathlib import Path

import jupytext
import nbformat
import pytest

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"
TIME_LIMIT = 240  # s for one cell, on two slow cores
FOUND = sorted(NOTEBOOKS.glob("*.py"))

_spec = importlib.util.spec_from_file_location("run_notebooks", ROOT / "docs" / "run_notebooks.py")
assert _spec is not None
assert _spec.loader is not None
running = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(running)


def test_there_are_notebooks():
    assert FOUND, f"no notebook in {NOTEBOOKS}"
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == {path.stem for path in FOUND}


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_the_notebook_with_outputs_is_that_of_its_script(path):
    """Cell for cell, whole, without a warning, and light enough to open."""
    target = path.with_suffix(".ipynb")
    assert running.is_current(path), f"python docs/run_notebooks.py {path.name}"
    assert running.faults(nbformat.read(target, 4)) == []
    assert target.stat().st_size < running.SIZE


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_notebook_explains_itself(path):
    """It opens with a title, and words stand between the code."""
    cells = jupytext.read(path).cells
    assert cells, "the notebook is empty"
    assert cells[0].cell_type == "markdown"
    assert cells[0].source.startswith("# ")
    assert sum(cell.cell_type == "markdown" for cell in cells) >= 3


def test_what_a_reader_must_not_meet_is_told():
    """A cell of 31 s, a warning, a cell that did not run, and no picture."""
    cells = [nbformat.v4.new_code_cell("work()", execution_count=count) for count in (1, None)]
    cells[0].outputs = [nbformat.v4.new_output("stream", name="stderr", text="UserWarning: no")]
    cells[0].metadata["seconds"] = 31.0
    said = running.faults(nbformat.v4.new_notebook(cells=cells))
    assert said == ["cell 1 took 31 s", "UserWarning: no", "a cell was not executed", "no picture"]


@pytest.mark.notebook
@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_notebook_runs(path, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    # the kernel must import the very package under test, wherever it is started
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])))
    for data in NOTEBOOKS.glob("*.csv"):  # they stand beside the notebooks
        shutil.copy(data, tmp_path)
    notebook = jupytext.read(path)
    with warnings.catch_warnings():
        # jupyter_client, pyzmq and asyncio warn about each other's deprecations
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", ResourceWarning)
        running.execute(notebook, tmp_path, TIME_LIMIT)
    assert [fault for fault in running.faults(notebook) if " took " not in fault] == []
