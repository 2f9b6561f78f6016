"""Percent scripts as pages: their text, their code, what it prints and draws."""

import contextlib
import io
import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"
NAMES = ("01_rlc_circuit", "02_one_dof_transmissibility", "03_two_dof_structure")


def write(folder):
    """Run the notebooks of the paper, unless their pages are newer."""
    folder.mkdir(exist_ok=True)
    for name in NAMES:
        source, target = NOTEBOOKS / f"{name}.py", folder / f"{name}.md"
        if not target.exists() or target.stat().st_mtime < source.stat().st_mtime:
            target.write_text(page(source, folder), encoding="utf-8")


def page(source, folder):
    """Markdown of one script; its pictures are written beside."""
    cells = re.split(r"^# %%", source.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    parts, scope, before = [], {}, plt.rcParams.copy()
    for number, cell in enumerate(cells):
        head, _, body = cell.partition("\n")
        if "[markdown]" in head:
            parts.append(re.sub(r"^# ?", "", body, flags=re.MULTILINE).strip())
            continue
        parts.append(f"```python\n{body.strip()}\n```")
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(compile(body, source.name, "exec"), scope)
        if said.getvalue().strip():
            parts.append(f"```text\n{said.getvalue().rstrip()}\n```")
        for figure in plt.get_fignums():
            name = f"{source.stem}_{number}_{figure}.png"
            plt.figure(figure).savefig(folder / name, dpi=90)
            parts.append(f"![{source.stem}, figure {figure} of cell {number}]({name})")
        plt.close("all")
    plt.rcParams.update(before)
    return "\n\n".join(parts) + "\n"
