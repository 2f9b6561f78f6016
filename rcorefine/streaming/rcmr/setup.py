"""Checked settings and prepared model of the paper's stages.

The model is discretized, with B_u, D_u and the delay of the path.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np

from ...exceptions import ModelError
from ...systems.conversion import to_discrete
from ...systems.discretization import check_sampling_time, discretize
from ...systems.linear import Array, LinearModel
from ..checks import as_matrix, as_rate, as_size
from .arrays import Plant
from .memory import Settings, regressor_length
from .path import column_delays, relative_degree
from .scaling import Scales, declared_scales

__all__ = ["Sampled", "Setup", "as_settings", "correction_path", "make_setup", "sampled_model"]

# Samples that tell the scales: a window, but no fewer and no more than this.
LEAST_WARM_UP, MOST_WARM_UP = 50, 100


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """The initial model and the samples that it meets.

    Parameters
    ----------
    initial, discrete : LinearModel
        Model as given, and in discrete time.
    step : float or None
        Sampling time in s, None where nobody told it.
    """

    initial: LinearModel
    discrete: LinearModel
    step: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Setup(Sampled):
    """Setup of the paper's stages before the first sample.

    Parameters
    ----------
    plant : Plant
        Discrete arrays with B_u and D_u, in the units of the signals.
    delay : int
        First Markov parameter that is not zero, d.
    settings : tuple of two Settings
        n_c, p, mu, alpha of both stages.
    estimated : bool
        Whether stage 2 sees the states of stage 1.
    average : int
        Samples that the static coefficients are averaged over.
    scales : Scales or None
        Declared scales.
    """

    plant: Plant
    delay: int
    settings: tuple[Settings, Settings]
    estimated: bool
    average: int
    scales: Scales | None

    @property
    def warm_up(self) -> int:
        """Samples that are held back to begin with, where scales are not declared."""
        return warm_up(self.settings)

    @property
    def theta_shapes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Shapes (l_u, l_psi) of the coefficients of both stages."""
        n, n_w = self.plant.B.shape
        l_u = self.plant.Bu.shape[1]
        first, second = ((l_u, regressor_length(n, n_w, l_u, s.order)) for s in self.settings)
        return first, second


def warm_up(settings: tuple[Settings, Settings]) -> int:
    """Return the number of samples that determine the scales.

    It is the length of a window, within a lower and an upper limit.
    """
    return min(max(settings[0].window, LEAST_WARM_UP), MOST_WARM_UP)


def make_setup(
    model: Sampled,
    settings: tuple[Settings, Settings],
    correction_input: Any,
    correction_feedthrough: Any,
    estimated: bool,
    average: int,
    scale: Any,
) -> Setup:
    """Check the arguments of the paper's stages and prepare the model.

    The arguments are those of `RCORefiner`.
    """
    initial, discrete, step = model.initial, model.discrete, model.step
    b_u, d_u = correction_path(initial, correction_input, correction_feedthrough)
    if initial.is_continuous and step is not None:
        b_u = discretize(initial.A, b_u, step)[1]
    arrays = (discrete.A, discrete.B, b_u, discrete.C, discrete.D, d_u)
    plant = Plant(*(np.ascontiguousarray(array) for array in arrays))
    delay = relative_degree(plant)
    column_delays(plant)
    scales = _declared(plant, scale, warm_up(settings))
    return Setup(initial, discrete, step, plant, delay, settings, estimated, average, scales)


def as_settings(
    order: Any,
    window: Any,
    markov: Any,
    learning_rate: Any,
    static_order: Any,
    static_window: Any,
    static_markov: Any,
    static_learning_rate: Any,
) -> tuple[Settings, Settings]:
    """Return the checked settings n_c, p, mu and alpha of both stages.

    Those of stage 2 default to those of stage 1.
    """
    first = Settings(
        as_size(order, "order", 0, "n_c"),
        as_size(window, "window", 1, "p"),
        as_size(markov, "markov", 1, "mu"),
        as_rate(learning_rate, "learning_rate"),
    )
    second = Settings(
        as_size(static_order, "static_order", 0, "n_c"),
        first.window if static_window is None else as_size(static_window, "static_window", 1, "p"),
        first.markov if static_markov is None else as_size(static_markov, "static_markov", 1, "mu"),
        first.learning_rate
        if static_learning_rate is None
        else as_rate(static_learning_rate, "static_learning_rate"),
    )
    return first, second


def correction_path(model: LinearModel, given: Any, feedthrough: Any) -> tuple[Array, Array]:
    """Return B_u and D_u in the timebase of the model.

    By default they are those of its inputs.
    """
    n, n_y = model.n_states, model.n_outputs
    b_u = model.B.copy() if given is None else as_matrix(given, "correction_input (B_u)", n, None, "state")
    l_u = b_u.shape[1]
    if feedthrough is not None:
        return b_u, as_matrix(feedthrough, "correction_feedthrough (D_u)", n_y, l_u, "output")
    return b_u, model.D.copy() if given is None else np.zeros((n_y, l_u))


def _declared(plant: Plant, scale: Any, n_samples: int) -> Scales | None:
    """Scales that the user declares, None for those to be measured."""
    if isinstance(scale, str) and scale == "auto":
        return None
    if not isinstance(scale, Mapping):
        raise ct.ControlArgument(
            f"scale must be 'auto' or a mapping such as {{'inputs': 1.0, 'outputs': 0.1}}, not {scale!r}"
        )
    return declared_scales(plant, scale, n_samples)


def sampled_model(model: Any, dt: float | None) -> Sampled:
    """Check the initial model and discretize it."""
    model = LinearModel.from_statespace(getattr(model, "system", model))
    if model.is_continuous and dt is None:
        raise ModelError(
            f"model {model.name!r} is continuous: give dt, the sampling time of the record in seconds"
        )
    if dt is not None:
        fixed = not model.is_continuous and model.dt is not None and model.dt is not True
        if fixed and abs(model.dt - check_sampling_time(dt)) > 1e-6 * model.dt:
            raise ModelError(
                f"dt = {dt!r} s contradicts model {model.name!r}, which has dt = {model.dt:g} s; "
                "leave dt out, or give the continuous model (rcorefine.d2c converts one)"
            )
        discrete = to_discrete(model, dt)
        return Sampled(model, discrete, float(discrete.dt))
    return Sampled(model, model, None if model.dt is None or model.dt is True else float(model.dt))
