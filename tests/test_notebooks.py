"""Every notebook stands beside its script with what it showed; nbmake runs it (notebooks/conftest.py)."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import jupytext
import nbformat
import pytest

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"
SIZE = 1_500_000  # bytes that a notebook may have
FOUND = sorted(NOTEBOOKS.glob("[0-9]*.py"))


def cells(notebook):
    """What a script and its notebook have in common."""
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def faults(notebook):
    """What a reader must not meet: warnings, cells that did not run, no picture at all."""
    code = [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]
    shown = [output for cell in code for output in cell.outputs]
    found = [output["text"] for output in shown if output.get("name") == "stderr"]
    found += [] if all(cell.execution_count for cell in code) else ["a cell was not executed"]
    found += [] if any("image/png" in output.get("data", {}) for output in shown) else ["no picture"]
    return found


def test_there_are_notebooks():
    assert FOUND, f"no notebook in {NOTEBOOKS}"
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == {path.stem for path in FOUND}


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_the_notebook_with_outputs_is_that_of_its_script(path):
    """Cell for cell, whole, without a warning, and light enough to open."""
    target = path.with_suffix(".ipynb")
    notebook = nbformat.read(target, 4)
    assert cells(notebook) == cells(jupytext.read(path)), f"{path.name}: write it anew (CONTRIBUTING.md)"
    assert faults(notebook) == []
    assert target.stat().st_size < SIZE


@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.name)
def test_notebook_explains_itself(path):
    """It opens with a title, and words stand between the code."""
    cells = jupytext.read(path).cells
    assert cells, "the notebook is empty"
    assert cells[0].cell_type == "markdown"
    assert cells[0].source.startswith("# ")
    assert sum(cell.cell_type == "markdown" for cell in cells) >= 3


def test_what_a_reader_must_not_meet_is_told():
    """A warning, a cell that did not run, and no picture."""
    cells = [nbformat.v4.new_code_cell("work()", execution_count=count) for count in (1, None)]
    cells[0].outputs = [nbformat.v4.new_output("stream", name="stderr", text="UserWarning: no")]
    said = faults(nbformat.v4.new_notebook(cells=cells))
    assert said == ["UserWarning: no", "a cell was not executed", "no picture"]


@pytest.mark.parametrize(
    "kind, fails", [("RuntimeWarning", 1), ("DeprecationWarning", 1), ("ResourceWarning", 0)]
)
def test_a_warning_that_a_reader_would_meet_fails_the_run(kind, fails):
    """Python shows the first two in a cell, and hides the third (its documentation of warnings)."""
    kernel = runpy.run_path(str(NOTEBOOKS / "conftest.py"))["KERNEL"]
    code = f"import warnings; warnings.warn('no', {kind})"
    command, environment = [sys.executable, "-c", code], os.environ | kernel
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert run.returncode == fails
    assert (f"{kind}: no" in run.stderr) == bool(fails)
