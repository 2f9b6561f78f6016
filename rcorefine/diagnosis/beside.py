"""Tests and odds of a free force at the place of a fitted effect."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ..effects.given import InputCurve, OutputCurve
from ..engine.amplitude_response import ResponseEngine
from ..inference.f_tests import FTest, project
from ..inference.fitted import FittedModel
from ..inference.free_form import Curve, averaged_evidence, channel_signal, curve_responses
from ..inference.sensitivities import force_responses
from ..systems.linear import Array
from .residual_tests import TestedResidual, in_rows, most_significant, over_frequency

_NESTED = (1, 2, 4, 8, 16)  # leading directions that are tested together
_SEEN = 1e-10  # least eigenvalue of a direction that is kept, over the largest
_RADII = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)  # radii of the stops over the standard deviation of the motion


class Beside:
    """Free forces, or free curves of a channel, at the place of an effect.

    Parameters
    ----------
    tested : TestedResidual
        Residual of the model with the effect.
    place : str
        Place of the effect: a port, an input or an output.

    Notes
    -----
    A joint test of all knots has little power against a force law that is nearly right. The test
    therefore takes nested sets of directions, first those in which a smooth curve changes the output most.
    The fitted coefficients are projected out before. This is the smooth test of Neyman (Skandinavisk
    Aktuarietidskrift 20 (1937) 149); the motion alone determines the order of the directions.

    A curve in displacement and velocity cannot represent hysteresis. The test "memory" covers that case with
    stops of several radii, the elements of the Prandtl-Ishlinskii model.
    """

    def __init__(self, tested: TestedResidual, place: str) -> None:
        self._tested, self.place = tested, place

    @cached_property
    def _forces(self) -> dict[str, list[Array]]:
        """Free forces (N, k) per record by test name, jointly of rms 1.

        Empty if the place is not a port, or if nothing moves there.
        """
        fitted, ratio = self._tested.fitted, self._tested.ratio
        # forces along the motion at the port: a free curve, and stops of several radii
        curve = curve_at(fitted, self.place, ratio)
        if curve is None:
            return {}
        motions = [fitted.port(self.place, ratio, i) for i in range(len(fitted.problem.records))]
        scale = float(np.std(np.concatenate([d if curve.d.size else v for d, v in motions])))
        made = {  # by the name of their test
            "free force": [curve.columns(d, v) @ curve.root for d, v in motions],
            "memory": [stops(d if curve.d.size else v, scale) for d, v in motions],
        }
        # scale: total force of rms 1, so that priors compare
        for name, blocks in made.items():
            size = float(np.sqrt(np.mean(np.sum(np.concatenate(blocks) ** 2, axis=1))))
            made[name] = [block / (size or 1.0) for block in blocks]
        return made

    @cached_property
    def _columns(self) -> dict[str, Array]:
        """Whitened responses to the free forces or curves, by test name.

        The directions of the fitted coefficients are projected out. A free curve of a channel is included
        only without process noise (ratio 0).
        """
        fitted, tested = self._tested.fitted, self._tested
        gain, found = fitted.gain(tested.ratio), {}
        responses = {}
        # response of the outputs to each force, by the linearized model
        for name, blocks in self._forces.items():
            forces = [[(self.place, column) for column in block.T] for block in blocks]
            responses[name] = [force_responses(fitted, i, f, gain) for i, f in enumerate(forces)]
        curve = curve_columns(fitted, self.place)
        if not responses and curve is not None and not tested.ratio:  # a predictor follows any sensor
            responses["free curve"] = curve
        for name, blocks in responses.items():
            # whiten, then project out what the fitted coefficients can explain
            columns = project(tested.whiten(blocks), tested.basis)
            if np.isfinite(columns).all() and columns.any():
                found[name] = columns
        return found

    @property
    def at_channel(self) -> bool:
        """Return whether the place has no free forces: a channel, or no motion."""
        return not self._forces

    def tests(self) -> list[FTest]:
        """Test the residual for a free force, for memory, or for a free curve.

        Returns
        -------
        list of FTest
            At a port "free force" and "memory", at a channel "free curve". Each has the smallest p-value of
            nested sets of directions, times the number of sets. Empty if no test applies.
        """
        return [
            nested(self._tested, f"{name} at {self.place}", columns)
            for name, columns in self._columns.items()
        ]

    def odds(self, size: float) -> float:
        """Return the log odds of a force that deviates from the force law.

        Parameters
        ----------
        size : float
            Size of the effect. At a port: standard deviation of its force along the motion. At a channel:
            norm of its contribution to the whitened outputs.

        Returns
        -------
        float
            Log odds against the fitted force law, averaged over the tests of `tests`. The size of the
            deviation has a uniform prior between zero and `size`. A record that cannot show such deviations
            gives log odds near 0. -inf if there is no free force.
        """
        if not self._columns:
            return -np.inf
        # averaged over the sizes of a normal prior; several families count equally
        each = []
        for columns in self._columns.values():
            scale = size / float(np.linalg.norm(columns)) if self.at_channel else size
            each.append(averaged_evidence(self._tested.left, scale * columns))
        return float(np.logaddexp.reduce(each) - np.log(len(each)))


def nested(tested: TestedResidual, name: str, columns: Array) -> FTest:
    """Return the best F-test of nested sets of directions of white columns.

    Its p-value is the smallest one times the number of sets (Bonferroni).
    """
    # principal directions of the columns, the largest first
    columns = columns / np.linalg.norm(columns)
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > _SEEN * values[-1]
    directions = columns @ vectors[:, kept][:, ::-1]
    counts = [k for k in _NESTED if k < directions.shape[1]] + [directions.shape[1]]
    # F-tests of 1, 2, 4, ... directions
    tests = [tested.of_white(name, directions[:, :k]) for k in counts]
    return most_significant(tests, len(tests))


def curve_at(fitted: FittedModel, place: str, ratio: float) -> Curve | None:
    """Return the knots of a free curve at a port, None without motion there."""
    if place not in [port.name for port in fitted.structure.model.ports]:
        return None
    # knots from the range of the motion
    d, v = motion_at(fitted, place, ratio)
    return Curve.along(place, d, v) if np.isfinite([d, v]).all() and (np.ptp(d) or np.ptp(v)) else None


def channel_curve(fitted: FittedModel, label: str) -> Curve | None:
    """Return the knots of a free curve of an input or an output.

    None if the label is no channel, or if its signal is constant. A curve has no knots where only samples
    lie that a delay hides.
    """
    model = fitted.structure.linear_model
    kind = InputCurve.name if label in model.input_labels else OutputCurve.name
    if label not in (*model.input_labels, *model.output_labels):
        return None
    signals = [channel_signal(fitted, label, i) for i in range(len(fitted.problem.records))]
    # samples that a delay hides from an output are left out
    if kind == OutputCurve.name:
        j = list(model.output_labels).index(label)
        signals = [x[w[j] > 0] for x, w in zip(signals, fitted.problem.judged(fitted.theta), strict=True)]
    x = np.concatenate(signals)
    curve = Curve.along(label, x, np.zeros(x.size), kind) if np.ptp(x) else None
    return curve if curve is not None and curve.d.size else None


def curve_columns(fitted: FittedModel, label: str) -> list[Array] | None:
    """Return the responses (n_y, N, k) to a free curve of a channel."""
    curve = channel_curve(fitted, label)
    blocks = [] if curve is None else curve_responses(fitted, fitted, curve, 0.0)
    return None if curve is None else [block @ curve.root for block in blocks]


def motion_at(fitted: FittedModel, place: str, ratio: float) -> tuple[Array, Array]:
    """Return displacement and velocity at a port, all records joined."""
    motions = [fitted.port(place, ratio, i) for i in range(len(fitted.problem.records))]
    return np.concatenate([d for d, _ in motions]), np.concatenate([v for _, v in motions])


def stops(x: Array, scale: float, radii: Sequence[float] = _RADII) -> Array:
    """Return the forces (N, k) of stops (springs that slip) along a motion.

    The radii are in units of `scale`. Each force has mean 0 and standard deviation 1, or is 0 everywhere.
    """
    found = np.empty((x.size, len(radii)))
    for column, radius in zip(found.T, radii, strict=True):
        z, reach = 0.0, radius * scale
        # Prandtl's stop operator: a spring that slips at its limit
        for k, moved in enumerate(np.diff(x, prepend=x[0])):
            z = min(max(z + moved, -reach), reach)
            column[k] = z
    size = found.std(axis=0)
    return np.asarray((found - found.mean(axis=0)) / np.where(size > 0, size, 1.0))


class FreeStiffness:
    """Free complex stiffness at the place of an effect.

    It is added to the effect. In a signal path, it is a free factor.

    Parameters
    ----------
    tested : TestedResidual
        Residual of the model with the law.
    place : str
        Where the law sits.

    Notes
    -----
    To frequency responses what `Beside` is to records in time: material damping, a bearing or a filter
    follow laws that are none of the library's, and look like the nearest one. A force
    ``-Z(omega) d`` with Z smooth over the logarithm of the frequency, real and imaginary part apart, holds
    every linear element at a port.
    """

    def __init__(self, tested: TestedResidual, place: str) -> None:
        self._tested, self.place = tested, place

    @cached_property
    def _columns(self) -> Array | None:
        """Return the columns of the free stiffness in the white residual.

        Together they have mean square 1. None is returned where nothing moves.
        """
        fitted, tested = self._tested.fitted, self._tested
        blocks = []
        for engine in fitted.problem.engines:
            assert isinstance(engine, ResponseEngine)
            # motion at the place, times smooth shapes over frequency, real and imaginary
            felt = engine.push(fitted.theta, self.place)
            if felt is None:
                return None
            shapes = over_frequency(engine.data)
            both = np.concatenate([felt[..., None] * shapes, 1j * felt[..., None] * shapes], axis=-1)
            blocks.append(fitted.problem.weights[:, None, None] * in_rows(engine.data, both))
        white = tested.whiten(blocks)
        size = float(np.sqrt(np.mean(np.sum(white**2, axis=1))))
        if not np.isfinite(size) or size == 0:
            return None
        return project(white / size, tested.basis)

    def tests(self) -> list[FTest]:
        """Test whether a free stiffness explains the remaining residual.

        The list is empty where nothing moves.
        """
        return (
            []
            if self._columns is None
            else [nested(self._tested, f"free stiffness at {self.place}", self._columns)]
        )

    def odds(self, before: FittedModel) -> float:
        """Log of the odds of a stiffness that departs from the law, over the law.

        Parameters
        ----------
        before : FittedModel
            Model without the law: what the law changes of the responses is the size of departures.

        Returns
        -------
        float
            As of `Beside.odds`.
        """
        if self._columns is None:
            return -np.inf
        theta, own = self._tested.fitted.theta, before.problem.n_theta
        changed = []
        # size of the effect's own contribution to the outputs, whitened
        for engine, plain in zip(self._tested.fitted.problem.engines, before.problem.engines, strict=True):
            run, without = engine.run(theta, sensitivity=False), plain.run(theta[:own], sensitivity=False)
            changed.append(self._tested.fitted.problem.weights[:, None] * (run.outputs - without.outputs))
        white = self._tested.whitener.apply(changed)
        return averaged_evidence(self._tested.left, float(np.sqrt(np.mean(white**2))) * self._columns)
