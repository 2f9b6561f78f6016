"""Protocol of the estimators behind `RCORefiner`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from ..systems.linear import Array, LinearModel
from .gaps import Block
from .rcmr.scaling import Scales
from .summary import Summary

__all__ = ["Estimator"]


class Estimator(Protocol):
    """Samples in; a refined model, its course and a summary out."""

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        ...

    @property
    def n_learned(self) -> int:
        """Samples learned from."""
        ...

    @property
    def form(self) -> str:
        """Form of the static correction that the refined model has."""
        ...

    @property
    def scores(self) -> dict[str, float]:
        """Fit in % of each form's free run, where several compete."""
        ...

    @property
    def scales(self) -> Scales | None:
        """Sizes that stage 1 divides signals by.

        None while they are not known or if stage 1 does not run.
        """
        ...

    @property
    def parameters(self) -> tuple[Any, ...]:
        """One row per static coefficient.

        An `RCOError` is raised if the coefficients are not parameters.
        """
        ...

    @property
    def covariance(self) -> Array:
        """Covariance of the static coefficients.

        An `RCOError` is raised if it is not known.
        """
        ...

    def take(self, block: Block, *, keep_sound: bool = False) -> None:
        """Learn from a block completely or not at all.

        With `keep_sound`, keep what came before a divergence.
        """
        ...

    def finish(self) -> None:
        """Learn from what is still held back: the record ends here."""
        ...

    def reset(self) -> None:
        """Forget all samples."""
        ...

    def predict(self, inputs: Array) -> Array:
        """Free run on further inputs of shape (N, n_w); outputs of shape (n_y, N)."""
        ...

    def system(self, name: str) -> LinearModel:
        """Refined model, continuous where the initial one is."""
        ...

    def discrete_system(self, name: str) -> LinearModel:
        """Refined model in discrete time."""
        ...

    def standard_deviations(self) -> Array:
        """Standard deviations of the static coefficients."""
        ...

    def deviation(self) -> Callable[[Array], Array] | None:
        """Return the standard deviation of the refined frequency response.

        It is a function of frequency, or None if it is not known.
        """
        ...

    def dynamic_theta(self) -> Array:
        """Coefficients of stage 1, empty where it does not run."""
        ...

    def static_theta(self) -> Array:
        """Static coefficients."""
        ...

    def history(self) -> Any:
        """Course of every sample."""
        ...

    def summary(self) -> Summary:
        """Cells and sentences of `str`."""
        ...

    def state(self) -> dict[str, Any]:
        """All that is remembered, for a file."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        ...
