"""Table of a response at stated amplitudes."""

from __future__ import annotations

import numpy as np

from ..engine.amplitude_response import AmplitudeResponse
from .tables import Table, tabulates

__all__ = ["amplitude_table"]

_NOTES = (
    "|G|: fundamental of the output divided by the sine at the input; its maximum is also searched between "
    "the frequencies. A linear model has the same |G| at every amplitude.",
    "distortion: the largest share of higher harmonics over the frequencies.",
)


def _title(found: AmplitudeResponse) -> str:
    lost, loose = int((~found.converged).sum()), int((found.converged & ~found.stable).sum())
    return (
        f"{found.name} driven by a sine at {found.input_label}: {found.omega.size} frequencies, "
        f"{found.omega.min():.4g} ... {found.omega.max():.4g} rad/s"
        + (f"; no steady state found at {lost} of {found.converged.size} points" if lost else "")
        + (f"; unstable at {loose} of {found.converged.size} points" if loose else "")
    )


@tabulates(AmplitudeResponse)
def amplitude_table(found: AmplitudeResponse) -> Table:
    """One row per amplitude and output."""
    rows = []
    for level, amplitude in enumerate(found.amplitude):
        for i, label in enumerate(found.output_labels):
            gain, omega = found.peak_gain[level, i], found.peak_omega[level, i]
            cells = ["-", "-", "-"]
            if np.isfinite(gain):
                most = 100 * np.nanmax(found.distortion[level, i])
                cells = [f"{gain:.4g}", f"{omega:.5g}", f"{most:.2g}"]
            rows.append([f"{amplitude:.4g} {found.input_unit}".strip(), label, *cells])
    headers = ["amplitude", "output", "largest |G|", "at [rad/s]", "distortion [%]"]
    return Table(headers, rows, _title(found), _NOTES, left=2)
