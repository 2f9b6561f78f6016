"""Notebooks with their outputs, from the percent scripts: python docs/run_notebooks.py [NAME ...].

Without names those that are older than their scripts are made anew. Nothing is written where a cell takes too
long, warns, or draws so much that the notebook is heavy. Needs the extras dev and distributed (psutil).
"""

import os
import sys
from pathlib import Path

import jupytext
import nbformat
import psutil
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"
CELL, SIZE = 30.0, 1_500_000  # s for a cell, bytes for a notebook
KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}


def cells(notebook):
    """What a script and its notebook have in common."""
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def is_current(script):
    """Whether a script's notebook stands beside it, cell for cell."""
    target = script.with_suffix(".ipynb")
    return target.exists() and cells(nbformat.read(target, 4)) == cells(jupytext.read(script))


def execute(notebook, folder, timeout):
    """Run all cells in a folder, pictures in the notebook; the seconds of each are kept in its metadata."""
    os.environ["RCOREFINE_PROGRESS"] = "0"
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
    notebook.metadata["kernelspec"] = KERNEL
    where = {"metadata": {"path": str(folder)}}
    client = NotebookClient(notebook, timeout=timeout, kernel_name="python3", resources=where)

    def spent():  # by the processor: a busy machine makes no cell slow
        return sum(psutil.Process(client.km.provisioner.pid).cpu_times()[:2])

    client.on_cell_start = lambda cell, cell_index: cell.metadata.update(seconds=-spent())
    client.on_cell_executed = lambda cell, cell_index, execute_reply: cell.metadata.update(
        seconds=cell.metadata["seconds"] + spent()
    )
    client.execute()
    nbformat.validate(notebook)


def faults(notebook):
    """What a reader must not meet: cells that take long, warnings, no picture at all."""
    code = [cell for cell in notebook.cells if cell.cell_type == "code" and cell.source.strip()]
    shown = [output for cell in code for output in cell.outputs]
    found = [f"cell {cell.execution_count} took {s:.0f} s" for cell in code if (s := seconds(cell)) > CELL]
    found += [output["text"] for output in shown if output.get("name") == "stderr"]
    found += ["a cell was not executed"] if not all(cell.execution_count for cell in code) else []
    found += [] if any("image/png" in output.get("data", {}) for output in shown) else ["no picture"]
    return found


def seconds(cell):
    """How long a cell took; 0 where that was not kept."""
    return cell.metadata.get("seconds", 0.0)


def make(script):
    """Execute one script and write its notebook beside it; the longest cell in s."""
    notebook = jupytext.read(script)
    execute(notebook, script.parent, timeout=600)
    longest, wrong = max(map(seconds, notebook.cells)), faults(notebook)
    notebook.metadata = {"kernelspec": KERNEL, "language_info": {"name": "python"}}
    for number, cell in enumerate(notebook.cells):  # what another run would change without a reason
        cell.metadata, cell.id = {}, f"cell-{number}"
    text = nbformat.writes(notebook, 4) + "\n"
    wrong += [f"{len(text)} bytes"] if len(text) > SIZE else []
    if wrong:
        raise SystemExit(f"{script.name}: {'; '.join(wrong)}")
    script.with_suffix(".ipynb").write_text(text, encoding="utf-8")
    return longest


if __name__ == "__main__":
    chosen = [name.removesuffix(".py") for name in map(os.path.basename, sys.argv[1:])]
    for script in sorted(NOTEBOOKS.glob("*.py")):
        if script.stem in chosen or not (chosen or is_current(script)):
            print(f"{script.name}: longest cell {make(script):.1f} s", flush=True)
