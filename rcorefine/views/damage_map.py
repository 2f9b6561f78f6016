"""Table and bar chart of a `DamageMap`."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_text
from ..exceptions import ModelError
from ..localization.damage_map import DamageMap, DamageRow
from ..results import shows
from ..systems.linear import Array
from ..words import chance, with_error
from .figures import Frame, draws, plain, unit_text
from .tables import WIDTH, html_table, number, text_table

__all__ = ["damage_html", "damage_text", "plot_damage"]

_CHANGED, _UNCHANGED = "0.25", "0.85"


def _value(row: DamageRow, figure: float, share: float) -> str:
    if row.nominal == 0:
        return number(figure, 3)
    return f"{share:.3g}" if abs(share) < 1e-3 else f"{share:.3f}" if abs(share) < 10 else f"{share:.2f}"


def _change_cells(result: DamageMap) -> tuple[list[str], list[list[str]]]:
    headers = ["what", "place", "model", "unit", "change", "95 % +/-", "limit", "p", ""]
    rows = []
    for row in result.rows:
        verdict = ("LOST" if row.change < 0 else "GAINED") if row.named else ""
        rows.append(
            [
                row.kind,
                row.place,
                number(row.nominal, 4) if row.nominal else "-",
                row.unit,
                _value(row, row.change, row.percent),
                _value(row, 1.96 * row.std, 1.96 * row.percent_std),
                _value(row, row.limit, row.limit_percent) if np.isfinite(row.limit) else "none",
                chance(row.p_value),
                verdict,
            ]
        )
    return headers, rows


def _ranking_cells(result: DamageMap) -> tuple[list[str], list[list[str]]]:
    headers = ["scenario", "changes [%]", "fit [%]", "BIC - best", "probability"]
    best = result.ranking[0].bic if result.ranking else 0.0
    rows = []
    for row in result.ranking:
        parts = [
            f"{row.percent[label]:.2f}" if label in row.percent else number(change, 3)
            for label, change in row.changes.items()
        ]
        rows.append(
            [
                row.name,
                ", ".join(parts) or "-",
                f"{min(row.fit):.4g}",
                f"{row.bic - best:.1f}",
                f"{row.probability:.3g}",
            ]
        )
    return headers, rows


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
    fits = ", ".join(
        f"{before:.4g} -> {after:.4g}" for before, after in zip(result.initial_fit, result.fit, strict=True)
    )
    lines.append(f"Fit of the initial model -> with the named changes: {fits} %.")
    lines.append(result.message)
    return lines


def _verdict(result: DamageMap) -> str:
    if not result.named:
        return "No change is significant in this record."
    parts = []
    for row in result.named:
        word = "lost" if row.change < 0 else "gained"
        if row.nominal:
            size = with_error(abs(row.percent), 1.96 * row.percent_std, "%")
            parts.append(f"{row.place} {word} {size} of its {row.kind}")
        else:
            parts.append(
                f"{row.place} {word} {with_error(abs(row.change), 1.96 * row.std, row.unit)} of {row.kind}"
            )
    return f"Changed: {'; '.join(parts)}."


def _title(result: DamageMap) -> str:
    return f"Damage in {result.name!r}: {result.n_samples} samples, {number(result.duration)} s"


@shows(DamageMap, "text")
def damage_text(result: DamageMap) -> str:
    """Tables of places and scenarios, at most 80 columns."""
    headers, rows = _change_cells(result)
    parts = [text_table(headers, rows, title=_title(result), left=2)]
    if result.ranking:
        headers, rows = _ranking_cells(result)
        parts.append("\n" + text_table(headers, rows, left=2))
    parts += [
        line for note in _sentences(result) for line in textwrap.wrap(note, WIDTH, subsequent_indent="  ")
    ]
    return "\n".join(parts)


@shows(DamageMap, "html")
def damage_html(result: DamageMap) -> str:
    """Return the damage map as HTML."""
    headers, rows = _change_cells(result)
    first = html_table(headers, rows, title=_title(result), notes=_sentences(result), left=2)
    if not result.ranking:
        return first
    headers, rows = _ranking_cells(result)
    return first + html_table(headers, rows, title="Scenarios, the most probable first", left=2)


@draws(DamageMap)
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
            panel.set_xticks(range(len(rows)))
            panel.set_xticklabels(frame.labels([row.place for row in rows]))
            panel.tick_params(axis="x", labelbottom=True)
            panel.set_ylabel(unit_text(f"change of {name}", "%" if relative else rows[0].unit))
            panel.set_xlim(-0.6, len(rows) - 0.4)
        title = plain(f"Changes in {result.name} (dark bars: named places)")
        return frame.finish(axes, lines, [axes[0, 0]], title)


def _bars(panel: Any, rows: Sequence[DamageRow], relative: bool) -> list[Any]:
    values = np.array([row.percent if relative else row.change for row in rows])
    spread = 1.96 * np.array([row.percent_std if relative else row.std for row in rows])
    limits = np.array([row.limit_percent if relative else row.limit for row in rows])
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
        chosen = np.array([i for i, row in enumerate(rows) if row.named == named], dtype=int)
        if chosen.size:
            drawn += list(
                panel.bar(where[chosen], values[chosen], 0.6, color=shade, edgecolor="black", label=text)
            )
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
    for x, half in enumerate(band):
        panel.plot([x - 0.45, x + 0.45], [half, half], color="black", linewidth=1.0, linestyle=":")
        panel.plot(
            [x - 0.45, x + 0.45], [-half, -half], color="black", linewidth=1.0, linestyle=":",
            label="detection limit" if x == 0 else None,
        )  # fmt: skip


def _write_values(panel: Any, rows: Sequence[DamageRow], values: Array, spread: Array) -> None:
    """The changes that are named, in figures."""
    for x, value, half, row in zip(range(len(rows)), values, spread, rows, strict=True):
        if row.named:
            offset = -4 if value < 0 else 4
            shown = f"{value:.1f}" if abs(value) >= 10 else f"{value:.3g}"
            panel.annotate(
                shown, (x, value - half if value < 0 else value + half), xytext=(0, offset),
                textcoords="offset points", ha="center", va="top" if value < 0 else "bottom",
            )  # fmt: skip
