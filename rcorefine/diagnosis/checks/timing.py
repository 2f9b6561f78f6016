"""Checks of sampling, hold and feedback.

They compare the sampling with the modes of the model, and test whether the inputs respond to the outputs.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import stats

from ...comparison.result import Comparison
from ...data.measurement import Measurement
from ...inference.whitening import Whitener
from ...models.controller import Controller, answer, unrecorded
from ...systems.linear import Array, LinearModel
from .row import LOOK, OK, CheckRow

__all__ = ["controller_rows", "feedback_rows", "sampling_rows"]

_LAGS = 20
_FEEDBACK = 1e-6  # p-value of past residuals in the input
_FREE = 1e-3  # turn over the record below which a mode is a free one, up to rounding
_STRONG = 0.15  # correlation: the innovations of steps are not independent, and make small ones by chance
_OTHER = 0.05  # share of an input that its controller does not give, from which it is worth a word
_RETURNS = 0.98  # correlation of an input with itself later, from which it is periodic


def sampling_rows(linear: LinearModel, data: Measurement, looped: bool = False) -> Iterator[CheckRow]:
    """Check sampling time and record length against the model's modes.

    Parameters
    ----------
    linear : LinearModel
        Model.
    data : Measurement
        Record.
    looped : bool
        Whether it runs in the loop of a controller.

    Yields
    ------
    CheckRow
    """
    poles = np.linalg.eigvals(linear.A) if linear.n_states else np.zeros(0)
    if not linear.is_continuous:
        with np.errstate(divide="ignore"):
            poles = np.log(poles.astype(complex)) / data.dt
    poles = poles[np.isfinite(poles)]
    limit = np.pi / data.dt
    fast = sorted({float(f"{abs(p.imag):.4g}") for p in poles if abs(p.imag) >= limit})
    figure = f"{data.n_samples} samples, {1 / data.dt:.4g} Hz"
    if fast:
        yield CheckRow(
            LOOK, "sampling", "", figure,
            f"Modes at {', '.join(f'{w:.4g}' for w in fast[:4])} rad/s lie above half the sampling "
            f"frequency ({limit:.4g} rad/s): their motion depends on the input between the samples.",
        )  # fmt: skip
    else:
        yield CheckRow(OK, "sampling", "", figure, "Every mode lies below half the sampling frequency.")
    length = data.dt * data.n_samples
    slow = [abs(p) for p in poles if _FREE < abs(p) * length < 2.0]
    if slow:
        yield CheckRow(
            LOOK, "length", "", f"{length:.4g} s",
            f"The slowest mode ({min(slow):.3g} rad/s) has hardly begun to settle in {length:.4g} s: the "
            "record contains little information about it.",
        )  # fmt: skip
    unstable = [p for p in poles if p.real * length > 1.0]
    if unstable and not looped:
        yield CheckRow(
            LOOK, "stability", "", f"pole at {max(p.real for p in unstable):.3g}",
            "The model is unstable, so it is judged by one-step predictions (or short simulations, "
            "horizon=). Gain and unit cannot be checked.",
        )  # fmt: skip


def controller_rows(controller: Controller, model: LinearModel, data: Measurement) -> Iterator[CheckRow]:
    """Check whether the controller reproduces the recorded inputs.

    The controller is fed with the record.

    Parameters
    ----------
    controller : Controller
        Around the model.
    model : LinearModel
        The model alone.
    data : Measurement
        Record, with what the controller read and what it gave.

    Yields
    ------
    CheckRow
        None where the record does not hold both.
    """
    given, _ = answer(controller, model, data)
    A, _, C, _ = controller.at(data.dt)
    if given is None or unrecorded(controller, model, data):
        return
    begun, x = np.zeros((data.n_samples, len(C), len(A))), np.eye(len(A))
    for k in range(data.n_samples):
        begun[k], x = C @ x, A @ x
    for i, where in enumerate(controller.driven):
        label = model.input_labels[where]
        row = data.input_labels.index(label) if label in data.input_labels else where
        u = data.inputs[row] + data.origin[row]
        left = u - given[i]
        left = left - begun[:, i] @ np.linalg.lstsq(begun[:, i], left, rcond=1e-10)[0]
        share = float(np.linalg.norm(left)) / max(float(np.linalg.norm(u - u.mean())), 1e-300)
        if share < _OTHER:
            yield CheckRow(
                OK,
                "controller",
                label,
                f"{100 * share:.2g} % deviation",
                "The controller reproduces the recorded input.",
            )
        else:
            yield CheckRow(
                LOOK, "controller", label, f"{100 * share:.2g} % deviation",
                f"With the record as its input, the controller gives another {label}. Possible causes: "
                "sign, sampling time, delay, an actuator limit, or an added signal.",
            )  # fmt: skip


def feedback_rows(compared: Comparison) -> Iterator[CheckRow]:
    """Check whether an input depends on past outputs (closed loop).

    Parameters
    ----------
    compared : Comparison
        Model on the record.

    Yields
    ------
    CheckRow

    Notes
    -----
    The innovation of an input that nobody steers by the outputs is independent of every past residual,
    whatever is wrong with the model. A periodic input has no innovation, so nothing is said there.
    """
    data = compared.data
    residuals = data.outputs - compared.runs[0]
    # where the input of a sample already shows in its output, only earlier residuals are past
    at_once = data.hold != "zoh" or bool(compared.models[0].D.any())
    for label, w in zip(data.input_labels, data.inputs, strict=True):
        if np.ptp(w) == 0 or _periodic(w) or data.n_samples < 10 * _LAGS:
            continue
        new = _white(w)
        for name, e in zip(data.output_labels, residuals, strict=True):
            p, most = _follows(new, _white(e), 1 if at_once else 0)
            if p < _FEEDBACK and most > _STRONG:
                yield CheckRow(
                    LOOK, "closed loop", label, f"p = {p:.1g}",
                    f"{label} depends on past values of {name} (correlation up to {most:.2g}): a controller "
                    "acts. Noise then enters the inputs, and simulations may be biased.",
                )  # fmt: skip
                return
    yield CheckRow(OK, "closed loop", "", "open", "No input was found to depend on past outputs.")


def _white(row: Array) -> Array:
    centered = (row - row.mean())[None]
    return Whitener.fit([centered]).apply([centered])


def _periodic(w: Array) -> bool:
    centered = w - w.mean()
    spectrum = np.abs(np.fft.rfft(centered, 2 * w.size)) ** 2
    own = np.fft.irfft(spectrum)[: w.size // 2] / np.arange(w.size, w.size - w.size // 2, -1)
    below = np.flatnonzero(own < 0.5 * own[0])
    return bool(below.size and np.max(own[below[0] :], initial=0.0) > _RETURNS * own[0])


def _follows(new: Array, past: Array, first: int) -> tuple[float, float]:
    """Return the p-value of independence and the largest correlation.

    The test asks whether the innovation of an input is independent of past residuals. Each product is weighed
    by its own size: an input that seldom steps counts as much as it has steps.
    """
    n = min(new.size, past.size)
    new, past = new[-n:], past[-n:]
    products = [new[k:] * past[: n - k] for k in range(first, _LAGS + first)]
    sums = np.array([p.sum() for p in products])
    z = sums / np.maximum([np.linalg.norm(p) for p in products], 1e-300)
    most = np.abs(sums).max() / (np.linalg.norm(new) * np.linalg.norm(past))
    return float(stats.chi2.sf(float(z @ z), _LAGS)), float(most)
