"""A physical model as text and as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from ..effects.effect import Effect
from ..models.parameters import NominalParameter
from ..models.physical_model import PhysicalModel
from ..results import shows
from .tables import WIDTH, html_table

__all__ = ["model_html", "model_text"]

_SHOWN = 12  # parameters in the text


@shows(PhysicalModel, "text")
def model_text(model: PhysicalModel) -> str:
    """Signals, places and nominal parameters in at most 80 columns.

    Parameters
    ----------
    model : PhysicalModel
        Model to describe.

    Returns
    -------
    str
        Lines of text.
    """
    linear = model.linear
    counts = ((linear.n_states, "state"), (linear.n_inputs, "input"), (linear.n_outputs, "output"))
    size = ", ".join(f"{count} {word}{'' if count == 1 else 's'}" for count, word in counts)
    lines = [f"Physical model {linear.name!r}: {size}"]
    for what, labels, units in (
        ("inputs", linear.input_labels, model.input_units),
        ("outputs", linear.output_labels, model.output_units),
        ("states", linear.state_labels, model.state_units),
    ):
        pairs = zip(labels, units, strict=True)
        lines += _wrap(f"{what:<8}", [f"{label} [{unit}]" if unit else label for label, unit in pairs])
    lines += _wrap("places  ", [port.name for port in model.ports])
    shown = model.parameters[:_SHOWN]
    if shown:
        width = max(len(item.name) for item in shown)
        lines.append("parameters of the initial model (an effect at the place adds to the value)")
        for item in shown:
            unit = "" if item.unit == "1" else item.unit
            value = f"{item.value:.6g} {unit}".strip()
            lines.append(f"  {item.name:<{width}} = {value:<20} {_called(model, item)}"[:WIDTH])
        if len(model.parameters) > len(shown):
            lines.append(f"  ... and {len(model.parameters) - len(shown)} more")
    return "\n".join(line.rstrip() for line in lines)


def _called(model: PhysicalModel, item: NominalParameter) -> str:
    """Return the effect that changes a parameter, as label and kind.

    The label uses the words of its place; `Effect` takes the kind.
    """
    plain = f"{item.kind} at {item.place}"
    label = model.check(Effect(item.kind, item.place)).label
    return plain if label == plain else f"{label} ({item.kind})"


@shows(PhysicalModel, "html")
def model_html(model: PhysicalModel) -> str:
    """Places and nominal parameters for a notebook.

    Parameters
    ----------
    model : PhysicalModel
        Model to describe.

    Returns
    -------
    str
        HTML, escaped.
    """
    rows = [[item.name, f"{item.value:.6g}", item.unit, item.kind, item.place] for item in model.parameters]
    ports = "".join(f"<li>{escape(str(port))}</li>" for port in model.ports)
    head = f"<p><b>Physical model {escape(repr(model.name))}</b></p><p>Places:</p><ul>{ports}</ul>"
    return head + html_table(["parameter", "value", "unit", "kind", "place"], rows)


def _wrap(head: str, items: Sequence[str]) -> list[str]:
    """Comma-separated items in lines of at most 80 columns."""
    lines, line = [], head
    for index, item in enumerate(items):
        piece = item + ("," if index + 1 < len(items) else "")
        if len(line) + 1 + len(piece) > WIDTH and line.strip():
            lines.append(line)
            line = " " * len(head)
        line += " " + piece
    return [*lines, line]
