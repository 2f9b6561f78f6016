"""Setup of a coefficient filter before the first sample.

It is the base for all kinds of coefficients.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ...arguments import as_noise, as_number, as_text
from ...exceptions import ModelError
from ...systems.linear import Array, LinearModel
from .kernel import Kernel
from .memory import CoefficientMemory
from .packed import Layout

__all__ = ["SHARE", "FilterSettings", "Setup", "checked_settings", "floor_at", "held_columns"]

SHARE = 1.0  # of its standard deviation that a coefficient may move before the model is discretized anew
_SOON = 500  # samples within which a second surprise means that not the state alone was wrong
DOUBT = 50.0  # samples that the first guess of the noise, the size of the outputs, counts for
_LIMIT = 1e12  # state over its size, beyond which the filter has diverged
NEVER = 1e300  # a threshold that nothing reaches, and still a finite number
_CHANGING = 0.03  # unknown force over the input where coefficients may change


@dataclass(frozen=True, slots=True, eq=False)
class FilterSettings:
    """Settings that every coefficient filter has.

    Parameters
    ----------
    dt : float
        Sampling time in s.
    hold : {"zoh", "foh"}
        The input between samples.
    noise : ndarray of shape (n_y,)
        Declared sensor noise, zero where it is estimated.
    disturbance : float
        Unknown force over the measured input, rms.
    forgetting : float
        Share of the information along the excited direction that a sample keeps.
    start_samples : int
        Samples that are gone over again while the model improves.
    """

    dt: float
    hold: str
    noise: Array
    disturbance: float
    forgetting: float
    start_samples: int = 2048

    @property
    def loose(self) -> bool:
        """Return whether the state always stays uncertain.

        This is so if unknown forces act or coefficients may change.
        """
        return self.disturbance > 0 or self.forgetting < 1


class Setup(ABC):
    """A model that depends on coefficients, and how they are estimated.

    Attributes
    ----------
    settings : FilterSettings
        Sampling, noise, memory.
    """

    settings: FilterSettings

    @property
    @abstractmethod
    def model(self) -> LinearModel:
        """Initial model."""

    @property
    @abstractmethod
    def layout(self) -> Layout:
        """Sizes of the packed memory."""

    @property
    @abstractmethod
    def labels(self) -> tuple[str, ...]:
        """Names of the coefficients."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the coefficients."""

    @property
    @abstractmethod
    def milestones(self) -> tuple[int, ...]:
        """Numbers of samples at which the first ones are gone over."""

    @property
    def n_laws(self) -> int:
        """Laws that may have a width of their own."""
        return 0

    @abstractmethod
    def start(self) -> Array:
        """Coefficients of the initial model."""

    @abstractmethod
    def compile(self, memory: CoefficientMemory) -> Kernel:
        """Discretize at `memory.centre` and pack what the loop needs."""

    @abstractmethod
    def go_over(self, memory: CoefficientMemory) -> CoefficientMemory:
        """Memory after the first samples, gone over again about a better model."""

    @abstractmethod
    def system(self, theta: Array, widths: Array, name: str) -> LinearModel:
        """Model at these coefficients, in the timebase that it is estimated in."""

    @abstractmethod
    def rows(self, theta: Array, spread: Array) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""

    def milestone(self, rounds: int) -> int:
        """Return after how many samples the first ones are filtered again.

        It is -1 if that never happens again.
        """
        lengths = self.milestones
        return lengths[rounds] if rounds < len(lengths) else -1

    def begin(self) -> CoefficientMemory:
        """Memory before the first sample."""
        lay = self.layout
        n_w = lay.nu - 1
        lower, upper = self.bounds
        origin = np.clip(self.start(), lower, upper)
        packed = np.zeros(lay.size)
        lay.view(packed, "theta")[:] = origin
        return CoefficientMemory(
            packed=packed,
            counters=self.counters(),
            centre=origin.copy(),
            origin=origin,
            spread=np.zeros(0),
            widths=np.full(self.n_laws, np.nan),
            sizes=np.zeros(n_w + lay.ny),
            states=np.zeros(0),
            inputs=np.zeros((0, n_w)),
            outputs=np.zeros((0, lay.ny)),
            known=np.zeros(0, dtype=np.uint8),
            use=np.zeros((0, lay.ny), dtype=np.uint8),
            rivals=np.zeros((0, lay.p)),
            rounds=0,
            discretized=0,
            renewed=0,
            doubted=0,
        )

    def counters(self) -> NDArray[np.int64]:
        """Counters of a filter before its first sample."""
        return np.array([0, 10 * self.layout.n + 10, int(self.settings.loose)], dtype=np.int64)

    def head(
        self,
        memory: CoefficientMemory,
        bounds: tuple[Array, Array],
        acting: Array,
        inputs: Array,
    ) -> tuple[list[Array], Array]:
        """First numbers that the loop needs, and the floor of the noise.

        Parameters
        ----------
        memory : CoefficientMemory
            Where to linearize.
        bounds : tuple of ndarray
            Bounds of the coefficients.
        acting, inputs : ndarray of shape (n, .)
            What unknown forces, and inputs that were not measured, move in a sample.
        """
        lay, settings = self.layout, self.settings
        limit = _LIMIT * (float(memory.states.max(initial=0.0)) or 1.0)
        y_size = memory.sizes[lay.nu - 1 :]
        floor = np.maximum(settings.noise**2, 1e-16 * y_size**2)
        scale = np.where(memory.spread > 0, memory.spread, 1.0) if memory.spread.size else np.ones(lay.p)
        numbers = np.array([self.share, settings.forgetting, limit, self.watch])
        head = [memory.centre, *bounds, 1e-6 * scale, floor, numbers]
        return [*head, (acting @ acting.T).ravel(), (inputs @ inputs.T).ravel()], floor

    @property
    def watch(self) -> float:
        """Mean square of normalized innovations at which the filter restarts."""
        return NEVER

    def prior_covariance(self, spread: Array) -> Array:
        """Covariance of the coefficients before the first sample, shape (p, p)."""
        return np.diag(spread**2)

    def renewed(self, memory: CoefficientMemory) -> CoefficientMemory:
        """Return a memory that no longer trusts its state.

        It does not trust its coefficients either if the last restart did not help for long.

        A bump moves the state alone. Where the coefficients were learned from something that is
        over, they begin anew as the initial ones: they may be far off.
        """
        lay, packed = self.layout, memory.packed.copy()
        counters = self.counters()
        counters[0] = memory.n_samples
        lay.view(packed, "Pb")[:] = np.diag(memory.states**2)
        lay.view(packed, "surprise")[:] = 0.0
        if memory.doubted == 0 or memory.n_samples - memory.doubted > _SOON:
            return replace(memory, packed=packed, counters=counters, doubted=memory.n_samples)
        lay.view(packed, "theta")[:] = memory.origin
        lay.view(packed, "S")[:] = 0.0
        lay.view(packed, "Pt")[:] = self.prior_covariance(memory.spread)
        level = lay.view(packed, "level")
        level[1] = np.maximum(level[0], level[1])
        lay.view(packed, "count")[:] = DOUBT
        return replace(
            memory, packed=packed, counters=counters, centre=memory.origin.copy(), kernel=None, doubted=0,
            renewed=memory.renewed + 1,
        )  # fmt: skip

    @property
    def share(self) -> float:
        """Standard deviations a coefficient may move before rediscretization."""
        return SHARE


def floor_at(lay: Layout) -> slice:
    """Return the position of the noise floor in the packed array."""
    return slice(4 * lay.p, 4 * lay.p + lay.ny)


def held_columns(M: Array, n: int, nu: int, hold: str) -> Array:
    """Return the columns of the linear part for the given hold.

    With a zero-order hold an input acts with its value at the start.
    """
    M = np.ascontiguousarray(M[:, :, : n + 2 * nu])
    if hold == "zoh":
        M[:, :, n : n + nu] += M[:, :, n + nu :]
        M[:, :, n + nu :] = 0.0
    return M


def checked_settings(
    n_outputs: int, dt: float, hold: str, noise: Any, disturbance: float | None, forgetting: float
) -> FilterSettings:
    """Settings of a coefficient filter, checked."""
    if as_text(hold, "hold") not in ("zoh", "foh"):
        raise ct.ControlArgument(
            f"hold must be 'zoh' or 'foh' on a stream, not {hold!r}; a band-limited input needs the future: "
            "use refine() on the record"
        )
    declared = as_noise(noise, n_outputs)
    levels = np.zeros(n_outputs) if declared is None else declared.copy()
    forgetting = as_number(
        forgetting, "forgetting (1 forgets nothing)", least=0.5, most=1.0, error=ModelError
    )
    if disturbance is None:
        # a state that is certain cannot follow a model that changes
        disturbance = 0.0 if forgetting == 1.0 else _CHANGING
    disturbance = as_number(disturbance, "disturbance", least=0.0, error=ModelError)
    return FilterSettings(dt, hold, levels, disturbance, forgetting)
