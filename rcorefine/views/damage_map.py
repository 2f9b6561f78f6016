"""Table and bar chart of a `DamageMap`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_text
from ..exceptions import ModelError
from ..inference.refinement import percent
from ..localization.damage_map import DamageMap, DamageRow
from ..results import chance, with_error
from ..systems.linear import Array
from .content import Content, content
from .figures import Frame, plain, unit_text, write_at
from .tables import TextTable, number

_CHANGED, _UNCHANGED = "0.25", "0.85"


def _value(row: DamageRow, figure: float, share: float) -> str:
    if row.nominal == 0:
        return number(figure, 3)
    return f"{share:.3g}" if abs(share) < 1e-3 else f"{share:.3f}" if abs(share) < 10 else f"{share:.2f}"


@content.register
def damage_content(result: DamageMap) -> Content:
    """Return the content of a damage map: each place, and the scenarios."""
    changes = []
    for row in result.rows:
        limit = _value(row, row.limit, row.limit_percent) if np.isfinite(row.limit) else "none"
        size = [_value(row, row.change, row.percent), _value(row, 1.96 * row.std, 1.96 * row.percent_std)]
        nominal = number(row.nominal, 4) if row.nominal else "-"
        verdict = ("LOST" if row.change < 0 else "GAINED") if row.named else ""
        changes.append([row.kind, row.place, nominal, row.unit, *size, limit, chance(row.p_value), verdict])
    title = f"Damage in {result.name!r}: {result.n_samples} samples, {number(result.duration)} s"
    headers = ["what", "place", "model", "unit", "change", "95 % +/-", "limit", "p", ""]
    tables = [TextTable(headers, changes, title, _sentences(result), left=2)]
    scenarios = []
    for one in result.ranking:
        parts = [
            f"{one.percent[label]:.2f}" if label in one.percent else number(change, 3)
            for label, change in one.changes.items()
        ]
        figures = [f"{min(one.fit):.4g}", f"{one.bic - result.ranking[0].bic:.1f}", f"{one.probability:.3g}"]
        scenarios.append([one.name, ", ".join(parts) or "-", *figures])
    headers = ["scenario", "changes [%]", "fit [%]", "BIC - best", "probability"]
    if scenarios:
        tables.append(TextTable(headers, scenarios, "Scenarios, the most probable first", left=2))
    named = [f"{row.kind} at {row.place}: {row.percent:.3g} %" for row in result.named]
    answer = [*named, result.message], not named
    return Content(tables=tables, answer=lambda: answer, pictures={"plot": plot_damage})


def _sentences(result: DamageMap) -> list[str]:
    lines = [_verdict(result)]
    if any(row.nominal for row in result.rows):
        lines.append(
            "change, 95 % interval and limit are in percent of the model's value"
            + ("" if all(row.nominal for row in result.rows) else ", or in the unit where it has none")
            + ". The change of a place that is not named is estimated in addition to the named ones."
        )
    lines.append(
        f"limit: the smallest change that this record would have shown with probability {result.power:g}. "
        "none: the record cannot show a change there."
    )
    lines.append(
        "p: probability of such a change by chance. Places are named at significance "
        f"{result.significance:g} for all tests together (Holm), if changes at other places cannot explain "
        "the data."
    )
    for row in result.named:
        if row.rivals:
            lines.append(f"The data can hardly distinguish {row.label} from {' or '.join(row.rivals)}.")
    for group in result.groups:
        lines.append(f"The data determine only a combination of these changes: {', '.join(group)}.")
    if result.damping == "ratio":
        lines += [
            f"{row.name[0].upper()}{row.name[1:]}: {with_error(row.value, 1.96 * row.std)}."
            for row in result.nuisances[-2:]
        ]
    pairs = zip(result.initial_fit, result.fit, strict=True)
    fits = ", ".join(f"{percent(before, after)} -> {percent(after, after)}" for before, after in pairs)
    lines.append(f"Fit of the initial model -> with the named changes: {fits}.")
    if not np.min(result.fit) > 0.0:
        lines.append("With the changes an output is worse than a constant: do not use them, check the model.")
    lines.append(result.message)
    return lines


def _verdict(result: DamageMap) -> str:
    if not result.named:
        return "No change is significant in this record."
    parts = []
    for row in result.named:
        size = with_error(abs(row.change), 1.96 * row.std, row.unit) + " of"
        if row.nominal:
            size = with_error(abs(row.percent), 1.96 * row.percent_std, "%") + " of its"
        parts.append(f"{row.place} {'lost' if row.change < 0 else 'gained'} {size} {row.kind}")
    return f"Changed: {'; '.join(parts)}."


def plot_damage(result: DamageMap, frame: Frame, *, kind: str | None = None) -> ct.ControlPlot:
    """Bar chart along the structure; see `DamageMap.plot`."""
    kinds = list(dict.fromkeys(row.kind for row in result.rows))
    if kind is not None:
        if as_text(kind, "kind") not in kinds:
            raise ModelError(f"kind {kind!r} is none of the candidates': {', '.join(kinds)}")
        kinds = [kind]
    with frame.axes([1.9] * len(kinds), 1) as (axes, lines):
        for panel, name in zip(axes[:, 0], kinds, strict=True):
            rows = [row for row in result.rows if row.kind == name]
            relative = all(row.nominal for row in rows)
            lines[kinds.index(name), 0] = _bars(panel, rows, relative)
            panel.set_xticks(range(len(rows)), frame.labels([row.place for row in rows]))
            panel.tick_params(axis="x", labelbottom=True)
            label = unit_text(f"change of {name}", "%" if relative else rows[0].unit)
            panel.set(ylabel=label, xlim=(-0.6, len(rows) - 0.4))
        return frame.finish(axes, lines, plain(f"Changes in {result.name} (dark bars: named places)"))


def _bars(panel: Any, rows: Sequence[DamageRow], relative: bool) -> list[Any]:
    fields = ("percent", "percent_std", "limit_percent") if relative else ("change", "std", "limit")
    values, spread, limits = np.array([[getattr(row, name) for row in rows] for name in fields], dtype=float)
    spread = 1.96 * spread
    where = np.arange(len(rows))
    top = float(np.max(np.abs(values) + np.where(np.isfinite(spread), spread, 0.0), initial=0.0))
    seen = limits[np.isfinite(limits)]
    if not any(row.named for row in rows):
        top = max(top, float(seen.max(initial=0.0)))
    top = 1.25 * top or 1.0
    panel.axhline(0.0, color="black", linewidth=0.8)
    _draw_limits(panel, np.where(np.isfinite(limits), np.minimum(limits, top), top))
    drawn = []
    for named, shade, text in ((True, _CHANGED, "named"), (False, _UNCHANGED, "not named")):
        chosen = [i for i, row in enumerate(rows) if row.named == named]
        if chosen:
            bars = panel.bar(where[chosen], values[chosen], 0.6, color=shade, edgecolor="black", label=text)
            drawn += list(bars)
    finite = np.isfinite(spread)
    panel.errorbar(
        where[finite], values[finite], spread[finite], fmt="none", ecolor="black", elinewidth=1.2, capsize=5,
        label="95 % interval",
    )  # fmt: skip
    _write_values(panel, rows, values, spread)
    panel.set_ylim(
        -top if values.min(initial=0.0) < 0 or seen.size else 0.0,
        max(0.25 * top, 1.2 * values.max(initial=0.0), 0.0),
    )
    return drawn


def _draw_limits(panel: Any, band: Array) -> None:
    """The band inside which a change would have stayed unseen."""
    look: dict[str, Any] = {"color": "black", "linewidth": 1.0, "linestyle": ":"}
    for x, half in enumerate(band):
        ends, label = [x - 0.45, x + 0.45], "detection limit" if x == 0 else None
        panel.plot(ends, [half, half], **look)
        panel.plot(ends, [-half, -half], label=label, **look)


def _write_values(panel: Any, rows: Sequence[DamageRow], values: Array, spread: Array) -> None:
    """The changes that are named, in figures."""
    for x, value, half, row in zip(range(len(rows)), values, spread, rows, strict=True):
        if row.named:
            down = value < 0
            shown = f"{value:.1f}" if abs(value) >= 10 else f"{value:.3g}"
            at = (x, value - half if down else value + half)
            write_at(panel, shown, at, (0, -4 if down else 4), ha="center", va="top" if down else "bottom")
