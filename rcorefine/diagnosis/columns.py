"""What each candidate, and each generic fault, would do to the residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..physics.effects import Effect
from ..physics.structure import Structure
from ..refinement.problem import Problem
from ..refinement.starts import Motion, shape_starts
from ..systems.discretization import discretize
from ..systems.linear import Array
from .state import Fitted, evaluated

__all__ = ["Candidate", "candidate_columns", "force_responses", "generic_forces", "slow_forces"]

# Kinds whose start is not "absent": their effect is the difference that they make there.
_SECANT = frozenset({"hidden_mode", "input_saturation", "output_saturation", "input_lag", "output_lag"})


@dataclass(eq=False)
class Candidate:
    """An effect, its problem, and the point at which it is absent."""

    effect: Effect
    problem: Problem
    starts: list[Array]
    columns: dict[float, list[Array]]  # by observer ratio: blocks (n_y, N, k) per record
    best_start: Array | None = None


def candidate_columns(
    fitted: Fitted, effects: Sequence[Effect], motion: Motion, ratios: Sequence[float]
) -> list[Candidate]:
    """Sensitivity of the residual to each candidate about the fitted model.

    Parameters
    ----------
    fitted : Fitted
        Model at its minimum.
    effects : sequence of Effect
        Candidates.
    motion : Motion
        Estimated motion, for the shapes of the laws.
    ratios : sequence of float
        Observer ratios, 0 for the free run.

    Returns
    -------
    list of Candidate
    """
    found = []
    p = fitted.structure.n_parameters
    for effect in effects:
        problem, point = fitted.extended([effect], motion)
        theta = problem.unpack(point)[0]
        shapes = shape_starts(problem.structure, theta, motion)
        starts = []
        for shape in shapes:
            shifted = point.copy()
            shifted[p : theta.size] = shape[p:]
            starts.append(problem.inside(shifted))
        columns: dict[float, list[Array]] = {}
        for ratio in ratios:
            gain = fitted.gain(ratio)
            wide: list[list[Array]] = [[] for _ in problem.records]
            for start in starts:
                K = None if gain is None else np.pad(gain, ((0, problem.n_states - gain.shape[0]), (0, 0)))
                blocks = evaluated(problem, start, K)
                for i, (residual, jacobian) in enumerate(blocks):
                    if effect.kind in _SECANT:
                        wide[i].append((residual - fitted.blocks(ratio)[i][0])[:, :, None])
                    else:
                        wide[i].append(jacobian[:, :, p : theta.size])
            columns[ratio] = [np.nan_to_num(np.concatenate(parts, axis=2)) for parts in wide]
        found.append(Candidate(effect, problem, starts, columns))
    return found


def generic_forces(structure: Structure, motion: Motion) -> list[tuple[str, Array]]:
    """Forces of laws that are in no library, at every port: (port, force of shape (N,))."""
    forces = []
    for port in structure.model.ports:
        d, v = motion.port(port.name)
        rms_d, rms_v = (float(np.sqrt(np.mean(s**2))) or 1.0 for s in (d, v))
        d, v = d / rms_d, v / rms_v
        laws = [v, np.sign(v), v * np.abs(v), v**3, np.abs(v)]
        if port.position.any() or port.position_input.any():
            laws += [d, d * d, d**3, d * np.abs(d), d**5, np.abs(d), d * np.abs(v), np.abs(d) * v, d * d * v]
        forces += [(port.name, law) for law in laws]
    return forces


def slow_forces(structure: Structure, motion: Motion) -> list[tuple[str, Array]]:
    """Forces of stiffness and damping that change over the record."""
    n = motion.data.n_samples
    t = np.linspace(-1.0, 1.0, n)
    shapes = [t, t * t, np.sin(2 * np.pi * t), np.cos(2 * np.pi * t)]
    forces = []
    for port in structure.model.ports:
        d, v = motion.port(port.name)
        for signal in (d, v):
            if np.any(signal):
                forces += [(port.name, signal * shape) for shape in shapes]
    return forces


def force_responses(
    fitted: Fitted, record: int, forces: Sequence[tuple[str, Array]], gain: Array | None = None
) -> Array:
    """Outputs that small forces at ports would add, linearized: (n_y, N, k), in units of the noise."""
    structure = fitted.structure
    matrices = structure.matrices(fitted.theta)
    n, n0 = structure.n_states, structure.linear_model.n_states
    data = fitted.problem.records[record]
    acts = np.zeros((n, len(forces)))
    for j, (name, _) in enumerate(forces):
        acts[:n0, j] = structure.model.port(name).act
    ports = list(dict.fromkeys(name for name, _ in forces))
    unique = np.column_stack([acts[:, [f[0] for f in forces].index(name)] for name in ports])
    rate = np.zeros((structure.n_outputs, n0))
    rate[:, :] = structure.model.output_rate
    through = rate @ unique[:n0]
    Phi, G0, G1 = discretize(matrices.A, unique, data.dt, "foh")
    where = np.array([ports.index(name) for name, _ in forces])
    F = np.array([force for _, force in forces]).T  # (N, k)
    drive0, drive1 = G0[:, where], G1[:, where]
    out = np.zeros((data.n_samples, structure.n_outputs, len(forces)))
    x = np.zeros((n, len(forces)))
    C, D = matrices.C, through[:, where]
    for k in range(data.n_samples):
        out[k] = C @ x + D * F[k]
        if gain is not None:
            x = x - gain @ out[k]
        if k + 1 < data.n_samples:
            x = Phi @ x + drive0 * F[k] + drive1 * F[k + 1]
    return np.asarray(np.moveaxis(out, 0, 1) * fitted.problem.weights[:, None, None])
