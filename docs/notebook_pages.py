"""Notebooks as pages: their text, their code, what it printed and drew when `run_notebooks.py` ran them."""

import base64
import json
from itertools import chain
from pathlib import Path

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"


def write(folder):
    """A page for each notebook, its pictures beside it."""
    folder.mkdir(exist_ok=True)
    for source in sorted(NOTEBOOKS.glob("*.ipynb")):
        cells = json.loads(source.read_text(encoding="utf-8"))["cells"]
        parts = [shown(cell, folder, f"{source.stem}_{number}") for number, cell in enumerate(cells)]
        text = "\n\n".join(chain.from_iterable(parts)) + "\n"
        target = folder / f"{source.stem}.md"
        if not target.exists() or target.read_text(encoding="utf-8") != text:
            target.write_text(text, encoding="utf-8")


def shown(cell, folder, name):
    """Markdown of one cell."""
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [source]
    parts = [f"```python\n{source}\n```"]
    for number, output in enumerate(cell["outputs"]):
        data = output.get("data", {"text/plain": output.get("text", "")})
        if "image/png" in data:
            picture = folder / f"{name}_{number}.png"
            picture.write_bytes(base64.b64decode(data["image/png"]))
            parts.append(f"![What this code draws]({picture.name})")
        elif text := "".join(data["text/plain"]).strip("\n"):
            parts.append(f"```text\n{text}\n```")
    return parts
