"""Text and plot of a hidden force, over time and against the motion."""

from __future__ import annotations

import control as ct
import numpy as np

from ..diagnosis.hidden_force import HiddenForce
from .figures import BAND, Frame, draws, style, unit_text
from .tables import Table, number, tabulates

__all__ = ["hidden_force_table", "plot_hidden_force"]


@tabulates(HiddenForce)
def hidden_force_table(found: HiddenForce) -> Table:
    """One row per signal."""
    rows = []
    signals = (
        ("displacement d", found.d, found.position_unit),
        ("velocity v", found.v, found.velocity_unit),
        ("resisting force", found.force, found.force_unit),
    )
    for name, x, unit in signals:
        rms = float(np.sqrt(np.mean(x**2)))
        rows.append([name, number(rms), number(x.min()), number(x.max()), unit])
    note = (
        f"Standard deviation of the force: {number(float(np.mean(found.std)))}. Its mean cannot be "
        "distinguished from the offset and is not estimated."
    )
    title = f"Hidden force at {found.place}, {found.force.size} samples"
    return Table(["signal", "rms", "least", "largest", "unit"], rows, title, notes=[note])


@draws(HiddenForce)
def plot_hidden_force(found: HiddenForce, frame: Frame) -> ct.ControlPlot:
    """Draw the force over time, displacement and velocity.

    See `HiddenForce.plot`.
    """
    label = unit_text("resisting force", found.force_unit)
    with frame.axes([1.0], 3, figsize=(11.0, 3.4), sharex=False, sharey=True) as (axes, lines):
        over_time, over_d, over_v = axes[0]
        wide = 2.0 * found.std
        over_time.fill_between(
            found.timepts, found.force - wide, found.force + wide, color=BAND, linewidth=0, label="2 std"
        )
        lines[0, 0] = over_time.plot(
            found.timepts, found.force, color=style(0).color, lw=0.8, label="estimate"
        )
        over_time.set_xlabel("time [s]")
        over_time.set_ylabel(label)
        for k, (axis, x, name, unit) in enumerate(
            (
                (over_d, found.d, "displacement", found.position_unit),
                (over_v, found.v, "velocity", found.velocity_unit),
            ),
            start=1,
        ):
            lines[0, k] = axis.plot(x, found.force, ".", color="0.5", ms=2, alpha=0.5)
            axis.set_xlabel(unit_text(f"{name} at {found.place}", unit))
        return frame.finish(axes, lines, [over_time], f"Hidden force at {found.place}")
