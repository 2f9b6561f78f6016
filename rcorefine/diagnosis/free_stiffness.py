"""Free complex stiffness in addition to the best candidate.

Its force is the motion there times any smooth complex function of frequency, without a force law.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..engine.response_engine import ResponseEngine
from ..inference.basis import project
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel
from ..inference.free_form import averaged_evidence
from ..systems.linear import Array
from .beside import nested
from .residual_tests import TestedResidual
from .response_tests import in_rows, over_frequency

__all__ = ["FreeStiffness"]


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
        for engine, plain in zip(self._tested.fitted.problem.engines, before.problem.engines, strict=True):
            run, without = engine.run(theta, sensitivity=False), plain.run(theta[:own], sensitivity=False)
            changed.append(self._tested.fitted.problem.weights[:, None] * (run.outputs - without.outputs))
        white = self._tested.whitener.apply(changed)
        return averaged_evidence(self._tested.left, float(np.sqrt(np.mean(white**2))) * self._columns)
