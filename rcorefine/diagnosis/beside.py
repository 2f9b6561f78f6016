"""A force of no law beside that of the winner: whether the record shows one, and whether it would have."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ..inference.basis import project
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel
from ..inference.free_form import Curve, averaged_evidence
from ..inference.sensitivities import force_responses
from ..systems.linear import Array
from .residual_tests import TestedResidual

__all__ = ["Beside", "channel_curve", "curve_at", "motion_at", "nested", "stops"]

_NESTED = (1, 2, 4, 8, 16)  # leading directions that are tested together
_SEEN = 1e-10  # of the largest: what a direction must move the output to be one
_RADII = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)  # of stops, over the rms of the motion


class Beside:
    """Free forces at the place of a law, or free curves of the channel where it sits, beside it.

    Parameters
    ----------
    battery : TestedResidual
        Residual of the model with the law.
    place : str
        Where the law sits: a port, an input or an output.

    Notes
    -----
    All knots at once would have little power against a law that is nearly right. The directions
    in which a smooth curve would move the output most, those of the fitted coefficients taken
    out, are tested first: the smooth test of Neyman (Skandinavisk Aktuarietidskrift 20 (1937)
    149) in an order that follows from the motion alone. No curve in displacement and velocity
    shows a law that remembers otherwise than the fitted one; stops of several widths do, of which
    every hysteresis of Prandtl and Ishlinskii is made.
    """

    def __init__(self, battery: TestedResidual, place: str) -> None:
        self._battery, self.place = battery, place

    @cached_property
    def _forces(self) -> dict[str, list[Array]]:
        """Free forces (N, k) per record, together of rms 1; none where nothing moves."""
        fitted, ratio = self._battery.fitted, self._battery.ratio
        curve = curve_at(fitted, self.place, ratio)
        if curve is None:
            return {}
        motions = [fitted.port(self.place, ratio, i) for i in range(len(fitted.problem.records))]
        scale = float(np.std(np.concatenate([d if curve.d.size else v for d, v in motions])))
        made = {  # by the name of their test
            "free force": [curve.columns(d, v) @ curve.root for d, v in motions],
            "memory": [stops(d if curve.d.size else v, scale) for d, v in motions],
        }
        for name, blocks in made.items():
            size = float(np.sqrt(np.mean(np.sum(np.concatenate(blocks) ** 2, axis=1))))
            made[name] = [block / (size or 1.0) for block in blocks]
        return made

    @cached_property
    def _columns(self) -> dict[str, Array]:
        """What they would do to the whitened residual, what was fitted already taken out."""
        fitted, battery = self._battery.fitted, self._battery
        gain, found = fitted.gain(battery.ratio), {}
        responses = {}
        for name, blocks in self._forces.items():
            forces = [[(self.place, column) for column in block.T] for block in blocks]
            responses[name] = [force_responses(fitted, i, f, gain) for i, f in enumerate(forces)]
        curve = channel_curve(fitted, self.place)
        if not responses and curve is not None and not battery.ratio:  # an observer follows any sensor
            responses["free curve"] = curve
        for name, blocks in responses.items():
            columns = project(battery.whiten(blocks), battery.basis)
            if np.isfinite(columns).all() and columns.any():
                found[name] = columns
        return found

    @property
    def at_channel(self) -> bool:
        """Whether the place is a channel, and no port."""
        return not self._forces

    def tests(self) -> list[FTest]:
        """Whether a free curve, and whether memory, explains what the model leaves there.

        Returns
        -------
        list of FTest
            Each the smallest p-value of nested sets of directions, times their number; empty where
            the place is no port or nothing moves.
        """
        return [
            nested(self._battery, f"{name} at {self.place}", columns)
            for name, columns in self._columns.items()
        ]

    def odds(self, size: float) -> float:
        """Log of the odds of a force that departs from the law, over the law.

        Parameters
        ----------
        size : float
            Of the law: standard deviation of its force along the motion; at a channel, norm of what it does
            to the whitened outputs.

        Returns
        -------
        float
            Departures up to the force of the law itself are as likely as each other: what the record
            would not have shown counts as much as what it shows. -inf where there is no free force.
        """
        if not self._columns:
            return -np.inf
        each = []
        for columns in self._columns.values():
            scale = size / float(np.linalg.norm(columns)) if self.at_channel else size
            each.append(averaged_evidence(self._battery.left, scale * columns))
        return float(np.logaddexp.reduce(each) - np.log(len(each)))


def nested(battery: TestedResidual, name: str, columns: Array) -> FTest:
    """Smallest p-value of nested sets of directions of white columns, times the number of sets."""
    columns = columns / np.linalg.norm(columns)
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > _SEEN * values[-1]
    directions = columns @ vectors[:, kept][:, ::-1]
    counts = [k for k in _NESTED if k < directions.shape[1]] + [directions.shape[1]]
    tests = [battery.of_white(name, directions[:, :k]) for k in counts]
    best = min(tests, key=lambda t: t.p_value)
    p, p_equal = (min(1.0, len(tests) * value) for value in (best.p_value, min(t.p_equal for t in tests)))
    return FTest(best.name, best.statistic, best.dof, p, best.gain, p_equal)


def curve_at(fitted: FittedModel, place: str, ratio: float) -> Curve | None:
    """Knots of a free curve at a port, None where the place is none or nothing moves."""
    if place not in [port.name for port in fitted.structure.model.ports]:
        return None
    d, v = motion_at(fitted, place, ratio)
    return Curve.along(place, d, v) if np.isfinite([d, v]).all() and (np.ptp(d) or np.ptp(v)) else None


def channel_curve(fitted: FittedModel, label: str) -> list[Array] | None:
    """Responses (n_y, N, k) per record to a free curve of an input or an output; None where there is none."""
    model, records = fitted.structure.linear_model, fitted.problem.records
    weights, held = fitted.problem.weights, fitted.blocks()
    if label in model.input_labels:
        j = list(model.input_labels).index(label)
        parts = [record.inputs[j] for record in records]
    elif label in model.output_labels:
        j = list(model.output_labels).index(label)
        parts = [r[j] / weights[j] + one.outputs[j] for (r, _), one in zip(held, records, strict=True)]
    else:
        return None
    joined = np.concatenate(parts)
    curve = Curve.along(label, joined, np.zeros(joined.size))
    if not curve.d.size:
        return None
    blocks = []
    for i, x in enumerate(parts):
        F = curve.columns(x, np.zeros(x.size)) @ curve.root
        if label in model.input_labels:
            blocks.append(force_responses(fitted, i, [(label, f) for f in F.T], fitted.gain(0.0)))
        else:
            blocks.append((weights * (np.array(model.output_labels) == label))[:, None, None] * F)
    return blocks


def motion_at(fitted: FittedModel, place: str, ratio: float) -> tuple[Array, Array]:
    """Displacement and velocity at a port over all records."""
    motions = [fitted.port(place, ratio, i) for i in range(len(fitted.problem.records))]
    return np.concatenate([d for d, _ in motions]), np.concatenate([v for _, v in motions])


def stops(x: Array, scale: float, radii: Sequence[float] = _RADII) -> Array:
    """Stops (N, k) of several radii, in units of `scale`: springs that slip, but for their mean."""
    found = np.empty((x.size, len(radii)))
    for column, radius in zip(found.T, radii, strict=True):
        z, reach = 0.0, radius * scale
        for k, moved in enumerate(np.diff(x, prepend=x[0])):
            z = min(max(z + moved, -reach), reach)
            column[k] = z
    size = found.std(axis=0)
    return np.asarray((found - found.mean(axis=0)) / np.where(size > 0, size, 1.0))
