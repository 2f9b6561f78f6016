"""Results of a refiner: coefficients, uncertainty and refined model."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, Unpack, cast
from weakref import WeakValueDictionary

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..exceptions import RCOError
from ..results import Options, Result, picture, show
from ..systems.linear import Array, LinearModel
from .coefficients.history import CoefficientHistory
from .estimator import Estimator
from .rcmr.history import History
from .rcmr.scaling import Scales
from .rcmr.setup import Sampled
from .summary import Summary

__all__ = ["Learned", "alone", "own_lock"]

_Method = TypeVar("_Method", bound=Callable[..., Any])
_locks: WeakValueDictionary[int, Any] = WeakValueDictionary()  # of all objects that live
_forking, _held = threading.Lock(), list[Any]()


def own_lock() -> threading.RLock:
    """Lock of one object, free in the child of a fork.

    A fork waits until no thread is in a locked method, so a child never gets an object half changed.
    """
    lock = threading.RLock()
    _locks[id(lock)] = lock
    return lock


def _before_fork() -> None:
    _forking.acquire()
    _held.extend(lock for ref in _locks.valuerefs() if (lock := ref()) is not None and lock.acquire())


def _after_fork() -> None:
    while _held:
        _held.pop().release()
    _forking.release()


if hasattr(os, "register_at_fork"):  # where there is fork
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork)


def alone(method: _Method) -> _Method:
    """Let only one thread at a time run a method.

    Thus no sample is lost between two threads.

    The kernels notice what overflows themselves; as plain Python they are as silent about it as compiled.
    """

    @wraps(method)
    def locked(self: Learned, *args: Any, **kwargs: Any) -> Any:
        with self._lock, np.errstate(all="ignore"):
            return method(self, *args, **kwargs)

    return cast(_Method, locked)


class Learned(Result):
    """Read-only view of what `RCORefiner` has learned."""

    _lock: threading.RLock
    _estimator: Estimator
    _sampled: Sampled
    _keep: bool
    _latest: Array
    model: Any

    @property
    @alone
    def n_samples(self) -> int:
        """Number of samples taken."""
        return self._estimator.n_samples

    @property
    @alone
    def n_learned(self) -> int:
        """Number of samples learned from.

        It is 0 while the first samples are held back for the scales.
        """
        return self._estimator.n_learned

    @property
    @alone
    def form(self) -> str:
        """Form of the static correction that the refined model has.

        "paper" by the paper's equations, "coefficients" where they were named; with competing forms
        "nonzero", "discrete", "input", or "initial" where no form predicts better than
        the initial model.
        """
        return self._estimator.form

    @property
    @alone
    def scores(self) -> dict[str, float]:
        """Simulation fit of each form in percent, in a model comparison.

        It refers to the last stretch that the forms had not seen.
        """
        return self._estimator.scores

    @property
    @alone
    def scales(self) -> Scales | None:
        """Sizes that stage 1 divides signals by.

        None while they are not known yet.
        """
        return self._estimator.scales

    @property
    @alone
    def theta(self) -> Array:
        """Dynamic coefficients in the units of the signals.

        The shape is (l_u, (n_c + 1)(n + n_w) + n_c l_u).

        Empty, of shape (0, 0), where stage 1 does not run.
        """
        return self._estimator.dynamic_theta()

    @property
    @alone
    def static_theta(self) -> Array:
        """Static coefficients, as changes of the initial model.

        They are in the units of the signals.

        By the paper's equations [theta_x, theta_w] of shape (l_u, n + n_w), the mean over the last
        `static_average` samples (`history.theta2` has those of each sample); else those of
        `parameters`, shape (1, p).
        """
        return self._estimator.static_theta()

    @property
    @alone
    def standard_deviations(self) -> Array:
        """Standard deviations of `static_theta`.

        They are infinite before anything is learned.

        Of the joint filter for white innovations; by the paper's equations the
        scatter over the samples that the coefficients are averaged over.
        """
        return self._estimator.standard_deviations()

    @property
    @alone
    def parameters(self) -> tuple[Any, ...]:
        """One row per coefficient, with its standard deviation at this sample.

        Rows have the fields name, kind, place, initial, value, coefficient,
        std, unit, role and interval (95 %); std is infinite before anything is learned.

        Raises
        ------
        RCOError
            By the paper's equations: their coefficients are no parameters.
        """
        return self._estimator.parameters

    @property
    @alone
    def covariance(self) -> Array:
        """Covariance of the coefficients at this sample, shape (p, p).

        Raises
        ------
        RCOError
            By the paper's equations.
        """
        return self._estimator.covariance

    @property
    @alone
    def discrete_system(self) -> ct.StateSpace:
        """Refined model in discrete time, labels kept."""
        return self._estimator.discrete_system(self._name()).to_statespace()

    @property
    @alone
    def system(self) -> ct.StateSpace:
        """Refined model: continuous if the initial one is, labels kept.

        Warns
        -----
        ConversionWarning
            If the refined discrete model has no continuous counterpart, as with a
            pole at zero: the nearest one of the same order is given, and
            `discrete_system` is exact.
        """
        return self._estimator.system(self._name()).to_statespace()

    @property
    @alone
    def history(self) -> History | CoefficientHistory:
        """Course of both stages, sample by sample.

        Raises
        ------
        RCOError
            If it was not asked for with ``history=True``.
        """
        if not self._keep:
            raise RCOError(
                "no history was kept: build the refiner with RCORefiner(..., history=True) and run it again "
                "(by default none is kept, so that a stream of any length takes constant memory)"
            )
        found: History | CoefficientHistory = self._estimator.history()
        return found

    @alone
    @picture
    def bode_plot(
        self, measured: Any = None, omega: ArrayLike | None = None, **options: Unpack[Options]
    ) -> ct.ControlPlot:
        """Draw a Bode plot of the initial and the refined model.

        The measured response is drawn beside them if it is given.

        The band about the refined curve is two standard deviations wide, as the coefficients
        are known; by the paper's equations there is none.

        Parameters
        ----------
        measured : Measurement or FrequencyResponse, optional
            Record, or its frequency response; drawn as dots with a band, and
            a row with the relative error of both models is added.
        omega : array_like of shape (n_omega,), optional
            Frequencies in rad/s.
        ax : array of Axes, optional
            Axes to draw in, shape (2 n_y, n_w), with `measured` (3 n_y, n_w).
        label : list of str, optional
            Labels of the two models.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        return show(self, "bode_plot", measured, omega, **options)

    @alone
    def _summary(self) -> Summary:
        """Cells and sentences of `str(refiner)`."""
        return self._estimator.summary()

    def _name(self) -> str:
        return f"{self._sampled.initial.name}$refined"

    def __getstate__(self) -> dict[str, Any]:
        state = dict(self.__dict__)
        del state["_lock"]
        if isinstance(self.model, ct.StateSpace):  # holds a lambda, which cannot be pickled
            state["model"] = self._sampled.initial
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = own_lock()
        if isinstance(self.model, LinearModel):
            self.model = self.model.to_statespace()
