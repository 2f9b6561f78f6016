"""Parameters of the healthy model with their uncertainty.

They are re-estimated as far as the baseline requires.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...data.measurement import Measurement
from ...effects.effect import Effect
from ...effects.output_path import OutputOffset
from ...engine.engine import Engine
from ...engine.structure import Structure
from ...gauss_newton import Rows
from ...inference.assembly import nominal_size
from ...inference.covariance import standard_deviations
from ...models.library import effect_library
from ...systems.linear import Array
from .baseline import FREE, RATIOS, Healthy, gain_of, learn
from .isolation import Segment, descend

__all__ = ["Numbers", "numbers_of", "offset", "settled"]

_ROUNDS = 3  # of noise for the numbers, and numbers for the noise
_LEAST = 1e-6  # variance of a combination of estimates that are alike but for the sign, relative
_AT_REST = 0.3  # standard deviations by which another round moves no number


@dataclass(frozen=True, eq=False)
class Numbers:
    """The healthy model, and how well it is known.

    Attributes
    ----------
    structure : Structure
        Model with all its numbers as effects.
    theta : ndarray, shape (q,)
        Their coefficients.
    substeps : int
        Substeps per sample.
    loose : ndarray of int, shape (p,)
        Those that are not known exactly.
    covariance : ndarray, shape (p, p)
        Of these.
    """

    structure: Structure
    theta: Array
    substeps: int
    loose: NDArray[np.int64]
    covariance: Array

    @cached_property
    def moving(self) -> list[tuple[Effect, str]]:
        """Effect and coefficient of each uncertain parameter.

        The force law is taken at the gap or limit that it has.
        """
        return [_seen_as(self.structure, self.theta, int(i)) for i in self.loose]


def _seen_as(structure: Structure, theta: Array, at: int) -> tuple[Effect, str]:
    parameter = structure.parameters[at]
    index = parameter.effect
    effect = structure.effects[index]
    shape = {name: float(structure.value(theta, index, name)) for name in effect.spec.shaping}
    fixed = {**effect.fixed, **shape}
    return Effect(effect.kind, effect.place, fixed=fixed, law=effect.law, name=effect.name), parameter.name


def numbers_of(
    structure: Structure, theta: Array, substeps: int, covariance: Array | None, tolerance: float
) -> Numbers:
    """Return the uncertain model parameters and estimated coefficients.

    Parameters
    ----------
    structure, theta, substeps
        Healthy model as it was given.
    covariance : ndarray, shape (q, q), or None
        Of `theta`, where it was estimated.
    tolerance : float
        Relative standard deviation of each number of the model.

    Returns
    -------
    Numbers
    """
    held = {(effect.kind, effect.place) for effect in structure.effects}
    extra: list[Effect] = []
    sizes: list[float] = []
    for effect in effect_library(structure.model) if tolerance > 0 else ():
        linear = (effect.spec.is_parameter or effect.spec.relative) and len(effect.free) == 1
        size = nominal_size(structure, effect) if linear else 0.0
        if 0.0 < size < np.inf and (effect.kind, effect.place) not in held:
            extra.append(effect)
            sizes.append(tolerance * size)
    offsets = [Effect(OutputOffset.name, label) for label in structure.linear_model.output_labels]
    extra += sorted(set(offsets) - set(structure.effects), key=offsets.index)
    sizes += [0.0] * (len(extra) - len(sizes))
    whole = Structure(structure.model, [*structure.effects, *extra], constants=structure.constants)
    q = whole.n_parameters
    spread = np.zeros((q, q))
    if covariance is not None:
        spread[: theta.size, : theta.size] = covariance
    spread[range(theta.size, q), range(theta.size, q)] = np.square(sizes)
    laws = [(whole.effects[p.effect].spec, p.name) for p in whole.parameters]
    known = np.array([law.along_motion and name not in law.shaping for law, name in laws], dtype=bool)
    finite = np.isfinite(spread).all(axis=0) & (np.diag(spread) > 0)
    loose = np.flatnonzero(known & finite)
    return Numbers(
        whole,
        np.concatenate([theta, np.zeros(q - theta.size)]),
        substeps,
        loose,
        spread[np.ix_(loose, loose)],
    )


def offset(numbers: Numbers, data: Measurement, use: NDArray[np.uint8]) -> Numbers:
    """Return the parameters with the constant offset of each sensor.

    The offsets are estimated together with the initial state.

    Without it, observer and parameters would follow the offset.
    """
    structure, theta = numbers.structure, numbers.theta
    n, ny = structure.n_states, structure.n_outputs
    gain, radius = gain_of(structure, theta, data, 0.0, False)
    if radius > FREE:
        gain, _ = gain_of(structure, theta, data, RATIOS[1], False)
    if not np.isfinite(gain).all():
        return numbers
    spread = np.array([np.std(y[there > 0]) for y, there in zip(data.outputs, use.T, strict=True)])
    segment = Segment(
        structure, theta, numbers.substeps, data, use, np.zeros(n), gain, np.zeros((ny, 0)),
        np.diag(1.0 / spread), np.ones((data.n_samples, ny)), True,
    )  # fmt: skip
    kinds = [structure.effects[parameter.effect].kind for parameter in structure.parameters]
    at = np.flatnonzero(np.array(kinds) == OutputOffset.name)
    beyond = np.full(at.size, np.inf)
    engine = Engine(structure, data, substeps=numbers.substeps)
    fit = descend(segment, engine, gain, segment.x0, theta.copy(), at, -beyond, beyond)
    theta = theta.copy()
    theta[at] = fit.coefficients
    return replace(numbers, theta=theta)


def settled(
    numbers: Numbers,
    data: Measurement,
    use: NDArray[np.uint8],
    disturbance: float | None,
    period: int,
) -> tuple[Numbers, Healthy]:
    """Return the most likely parameters and noise of the healthy samples.

    The parameters come with their remaining uncertainty.

    Parameters
    ----------
    numbers : Numbers
        As they are known before.
    data, use, disturbance, period
        As for `learn`.

    Returns
    -------
    numbers : Numbers
        As they are known afterwards.
    healthy : Healthy
        Observer and noise.
    """
    before, most = numbers, np.inf
    for _ in range(_ROUNDS):
        healthy, sound, scale = learn(
            numbers.structure, numbers.theta, numbers.substeps, data, use, disturbance, period, most
        )
        most = max(healthy.ratio, RATIOS[1])
        if numbers.loose.size == 0:
            break
        last, numbers = numbers, _fitted(before, numbers.theta, data, sound, scale, healthy)
        moved = np.abs(numbers.theta - last.theta)[numbers.loose]
        if (moved < _AT_REST * standard_deviations(numbers.covariance)).all():
            break
    return numbers, healthy


def _fitted(
    before: Numbers,
    start: Array,
    data: Measurement,
    use: NDArray[np.uint8],
    scale: Array,
    healthy: Healthy,
) -> Numbers:
    """The numbers at the maximum of their posterior."""
    structure, loose = before.structure, before.loose
    outputs = data.outputs - healthy.mean[:, None]
    shifted = Measurement(data.inputs, outputs, dt=data.dt, hold=data.hold)
    engine = Engine(structure, shifted, substeps=before.substeps)
    segment = Segment(
        structure, before.theta, before.substeps, shifted, use, healthy.x0, healthy.gain, healthy.filters,
        healthy.mix, scale, True,
    )  # fmt: skip
    size = standard_deviations(before.covariance)
    values, vectors = np.linalg.eigh(before.covariance / np.outer(size, size))
    precision = (vectors / np.sqrt(np.maximum(values, _LEAST))).T / size
    centre = before.theta[loose]
    bounds = np.array([(structure.parameters[i].lower, structure.parameters[i].upper) for i in loose])
    found = descend(
        segment, engine, healthy.gain, healthy.x0, start, loose, bounds[:, 0], bounds[:, 1],
        prior=lambda point: Rows(precision @ (point - centre), precision),
    )  # fmt: skip
    if not np.isfinite(found.cost):
        return before
    theta = start.copy()
    theta[loose] = found.coefficients
    return replace(before, theta=theta, covariance=found.covariance)
