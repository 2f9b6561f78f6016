"""The picture of a diagnosis: ranking, hidden force against motion, residual before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import control as ct
import matplotlib.pyplot as plt
import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import welch

from ..engine.simulation import simulate
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel
from .figures import MEASURED, finish, picture, settings, style, unit_text

if TYPE_CHECKING:
    from ..data.measurement import Measurement
    from ..diagnosis.result import Diagnosis
    from ..models.ports import Port

__all__ = ["diagnosis_plot", "estimated_force"]

_LEVELS = np.logspace(-3, 1, 9)  # of the force that drives the estimate, tried by likelihood
_MEMORY = (3.0, 12.0, 50.0)  # samples for which it lasts, tried too
_TRIED_ON = 1000  # samples
_SHOWN = 8
_ALONG_D = frozenset(
    {
        "stiffness",
        "cubic_stiffness",
        "quadratic_stiffness",
        "bilinear_stiffness",
        "clearance",
        "hysteresis",
    }
)


@picture
def diagnosis_plot(
    found: Diagnosis,
    *,
    title: str | None = None,
    rcParams: dict[str, Any] | None = None,
    legend_loc: str | bool | None = None,
    show_legend: bool | None = None,
) -> ct.ControlPlot:
    """Draw what a diagnosis rests on.

    Parameters
    ----------
    found : Diagnosis
        Result of `diagnose`.
    title : str, optional
        Title of the figure; by default the verdict.
    rcParams : dict, optional
        Matplotlib settings.
    legend_loc, show_legend
        As in python-control's plots.

    Returns
    -------
    ControlPlot
        Axes: ranking (or tests, where nothing is missing), hidden force estimated without
        any law with the law's curve through it, residual in time, residual in frequency.
    """
    record = found.ordered_records()[0]
    with settings(rcParams):
        figure, axes = plt.subplots(2, 2, figsize=(10.5, 7.2), layout="constrained", squeeze=False)
        lines = np.empty((2, 2), dtype=object)
        lines[0, 0] = _ranking(axes[0, 0], found) if found.best is not None else _tests(axes[0, 0], found)
        lines[0, 1] = _force(axes[0, 1], found, record)
        lines[1, 0], lines[1, 1] = _residuals(axes[1], found, record)
        return finish(
            figure,
            axes,
            lines,
            title=_title(found) if title is None else title,
            legends=[axes[0, 0], axes[0, 1], axes[1, 1]],
            legend_loc=legend_loc,
            show_legend=show_legend,
        )


def _title(found: Diagnosis) -> str:
    if found.best is None or found.verdict == "adequate":
        return f"Diagnosis: {found.verdict}"
    return f"Diagnosis: {found.verdict} ({found.best.effect.label}, probability {found.best.probability:.2f})"


def _ranking(ax: Any, found: Diagnosis) -> list[Any]:
    rows = found.ranking[:_SHOWN][::-1]
    where = np.arange(len(rows))
    alike = {effect.label for effect in found.ambiguous}
    colors = [style(1).color if row.effect.label in alike else "0.75" for row in rows]
    loss = [100 - row.fit_after for row in rows]
    bars = ax.barh(where, loss, color=colors, edgecolor="0.3", height=0.65)
    before = 100 - rows[0].fit_before
    line = ax.axvline(before, color=style(0).color, ls="--", lw=1.4, label="model as it is")
    for y, row, value in zip(where, rows, loss, strict=True):
        ax.annotate(
            f"P = {row.probability:.2f}",
            (value, y),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    ax.set_yticks(where, [_wrapped(row.effect.label) for row in rows], fontsize=8)
    ax.set_xlim(0, 1.25 * max(before, *loss))
    ax.set_xlabel("what the refitted model misses: 100 - fit [%]")
    ax.set_title("Rivals, refitted")
    return [*bars, line]


def _wrapped(label: str) -> str:
    return label.replace(" at ", "\nat ").replace("_", " ").replace("$", r"\$")


def _tests(ax: Any, found: Diagnosis) -> list[Any]:
    tests = [t for t in found.tests if t.dof][::-1]
    where = np.arange(len(tests))
    bars = ax.barh(
        where, [-np.log10(max(t.p_value, 1e-300)) for t in tests], color="0.75", edgecolor="0.3", height=0.65
    )
    level = -np.log10(found.significance / max(len(tests), 1))
    line = ax.axvline(level, color=style(1).color, ls="--", lw=1.4, label="level at which a test fires")
    ax.set_yticks(where, [t.name.split(" (")[0] for t in tests], fontsize=8)
    ax.set_xlim(0, max(1.2 * level, ax.get_xlim()[1]))
    ax.set_xlabel("-log10 of the p-value")
    ax.set_title("Tests of the model")
    return [*bars, line]


def _force(ax: Any, found: Diagnosis, record: Measurement) -> list[Any]:
    best = found.best
    port = None
    if best is not None:
        port = next((p for p in best.refinement.physical_model.ports if p.name == best.effect.place), None)
    if best is None or port is None:
        said = (
            "nothing is missing" if best is None else f"{best.effect.label}\nis in the signal path: no force"
        )
        ax.text(0.5, 0.5, said, ha="center", va="center", transform=ax.transAxes)
        ax.set_axis_off()
        return []
    force, states = estimated_force(found, port, record)
    d = port.position @ states + port.position_input @ record.inputs
    v = port.velocity @ states + port.velocity_input @ record.inputs
    along_d = best.effect.kind in _ALONG_D
    motion = d if along_d else v
    unit = port.position_unit if along_d else port.velocity_unit
    what = "displacement" if along_d else "motion" if port.kind == "first_order" else "velocity"
    skip = max(record.n_samples // 50, 1)
    inner = slice(skip, -skip)
    law = _law(found, d, v, motion)
    # a constant force passes for the offset: the estimate has none, the law's is put in its place
    force = force - force[inner].mean() + (0.0 if law is None else float(np.mean(law[1])))
    points = ax.plot(
        motion[inner],
        force[inner],
        ".",
        color="0.55",
        ms=2,
        alpha=0.5,
        label="estimated from the record, no law assumed",
    )
    edges = np.quantile(motion[inner], np.linspace(0.005, 0.995, 25))
    which = np.digitize(motion[inner], edges)
    centers, means = [], []
    for i in range(1, edges.size):
        if np.count_nonzero(which == i) > 5:
            centers.append(motion[inner][which == i].mean())
            means.append(force[inner][which == i].mean())
    points += ax.plot(centers, means, "o", color=MEASURED, ms=4, label="its mean at each motion")
    if law is not None:
        x, y = law
        look = style(1)
        points += ax.plot(x, y, color=look.color, ls=look.linestyle, lw=2, label=best.effect.label)
    ax.set_xlabel(
        unit_text(
            f"{what} at {port.name}",
            unit,
        )
    )
    ax.set_ylabel(unit_text("hidden resisting force", port.force_unit))
    ax.set_title("What the record says about the force")
    return list(points)


def _law(found: Diagnosis, d: Array, v: Array, motion: Array) -> tuple[Array, Array] | None:
    from ..effects.along_motion import unit_forces

    assert found.best is not None
    effect, values = found.best.effect, dict(found.best.coefficients)
    order = np.argsort(motion, kind="stable")
    if effect.kind in ("stiffness", "damping"):
        return motion[order], values[effect.kind] * motion[order]
    shape = {**values, **effect.fixed}
    columns = unit_forces(effect, d, v, [shape])
    levels = [
        values.get(n, effect.fixed.get(n, 0.0))
        for n in effect.coefficients
        if n not in ("gap", "threshold", "velocity", "displacement")
    ]
    if columns is None or len(columns) != len(levels):
        return None
    force = np.sum([level * column for level, column in zip(levels, columns, strict=True)], axis=0)
    if effect.kind == "hysteresis":
        return motion, force
    return motion[order], force[order]


def _residuals(axes: Any, found: Diagnosis, record: Measurement) -> tuple[list[Any], list[Any]]:
    models = [("as it is", found.base)]
    if found.best is not None:
        models.append((f"with {found.best.effect.label}", found.best.refinement))
    in_time, in_frequency = [], []
    scale = record.outputs.std(axis=1)
    main = int(np.argmax(scale > 0))
    for i, (name, model) in enumerate(models):
        error = record.outputs[main] - simulate(model, record).outputs[main]
        look = style(i)
        in_time += axes[0].plot(record.timepts, error, color=look.color, lw=0.7, label=name)
        f, power = welch(error, fs=1 / record.dt, nperseg=min(512, record.n_samples))
        in_frequency += axes[1].loglog(
            f[1:], np.sqrt(power[1:]), color=look.color, ls=look.linestyle, lw=1.4, label=name
        )
    f, power = welch(record.outputs[main], fs=1 / record.dt, nperseg=min(512, record.n_samples))
    in_frequency += axes[1].loglog(
        f[1:], np.sqrt(power[1:]), color=MEASURED, lw=0.9, alpha=0.6, label="measured output"
    )
    label, unit = record.output_labels[main], record.output_units[main]
    axes[0].set_xlabel("time [s]")
    axes[0].set_ylabel(unit_text(f"residual of {label}", unit))
    axes[0].set_title("Residual in time")
    axes[1].set_xlabel("frequency [Hz]")
    axes[1].set_ylabel(unit_text("amplitude density", f"{unit}/sqrt(Hz)" if unit else ""))
    axes[1].set_title("Residual in frequency")
    return in_time, in_frequency


def estimated_force(found: Diagnosis, port: Port, record: Measurement) -> tuple[Array, Array]:
    """Force at a port and the motion, from the record and the model as it is, without any law.

    The force is one more state of a Kalman smoother, driven by noise; how strongly, and how
    long it remembers, is chosen by likelihood. Its mean is no part of the estimate.

    Parameters
    ----------
    found : Diagnosis
        Result of `diagnose`.
    port : Port
        Where the force acts.
    record : Measurement
        Record, channels in the order of the model.

    Returns
    -------
    force : ndarray, shape (N,)
        Resisting force.
    states : ndarray, shape (n, N)
        States of the linear model.
    """
    linear = LinearModel.from_statespace(found.base.system)
    n = linear.n_states
    act = np.zeros(n)
    act[: port.act.size] = port.act
    rate = np.zeros((linear.n_outputs, n))
    given = found.base.physical_model.output_rate
    rate[:, : given.shape[1]] = given
    B = np.vstack([linear.B, np.zeros((1, linear.n_inputs))])
    C = np.column_stack([linear.C, rate @ act])
    hold = "zoh" if record.hold == "zoh" else "foh"
    w = record.inputs
    level = found.best.refinement.rmse if found.best is not None else found.base.rmse
    R = np.diag(np.maximum(level, 1e-6 * record.outputs.std(axis=1)) ** 2)
    y = record.outputs - linear.D @ w
    y = y - y.mean(axis=1, keepdims=True)
    runs = []
    for memory in _MEMORY:
        A = np.zeros((n + 1, n + 1))
        A[:n, :n], A[:n, n], A[n, n] = linear.A, act, -1.0 / (memory * record.dt)
        F, G0, G1 = discretize(A, B, record.dt, hold)
        drive = G0 @ w[:, :-1] + G1 @ w[:, 1:]
        # a force that moves the output by its own size within a sample: the scale of the walk
        reach = np.linalg.norm(C @ F[:, -1]) + np.linalg.norm(C[:, -1]) + 1e-300
        unit = float(np.linalg.norm(y.std(axis=1))) / reach
        short = min(_TRIED_ON, y.shape[1])
        for share in _LEVELS:
            try:
                run = _smoother(F, C, drive[:, : short - 1], y[:, :short], R, share * unit)
            except (np.linalg.LinAlgError, ValueError):
                continue  # no stationary filter at this level; the next one may have
            runs.append((run[0], F, drive, share * unit))
    if not runs:
        return np.zeros(record.n_samples), np.zeros((n, record.n_samples))
    _, F, drive, walk = max(runs, key=lambda run: run[0])
    smooth = _smoother(F, C, drive, y, R, walk)[1]
    return smooth[n], smooth[:n]


def _smoother(F: Array, C: Array, drive: Array, y: Array, R: Array, walk: float) -> tuple[float, Array]:
    """Stationary Kalman filter forth, Rauch-Tung-Striebel back: log-likelihood and states."""
    n, N = F.shape[0], y.shape[1]
    Q = np.zeros((n, n))
    Q[-1, -1] = walk**2
    size = np.ones(n)
    size[-1] = walk
    Fs, Cs, Qs = F * size / size[:, None], C * size, Q / np.outer(size, size)
    Qs = Qs + 1e-12 * np.eye(n) * np.mean(np.diag(R))
    P = solve_discrete_are(Fs.T, Cs.T, Qs, R)
    S = Cs @ P @ Cs.T + R
    K = P @ Cs.T @ np.linalg.inv(S)
    after = P - K @ Cs @ P
    J = np.linalg.solve(P.T, (after @ Fs.T).T).T
    steer = drive / size[:, None]
    before_all, after_all = np.zeros((n, N)), np.zeros((n, N))
    x = np.zeros(n)
    errors = np.zeros_like(y)
    for k in range(N):
        before_all[:, k] = x
        errors[:, k] = y[:, k] - Cs @ x
        z = x + K @ errors[:, k]
        after_all[:, k] = z
        if k + 1 < N:
            x = Fs @ z + steer[:, k]
    smooth = np.zeros((n, N))
    smooth[:, -1] = after_all[:, -1]
    for k in range(N - 2, -1, -1):
        smooth[:, k] = after_all[:, k] + J @ (smooth[:, k + 1] - before_all[:, k + 1])
    likelihood = -0.5 * (N * np.linalg.slogdet(S)[1] + float(np.sum(errors * np.linalg.solve(S, errors))))
    return likelihood, smooth * size[:, None]
