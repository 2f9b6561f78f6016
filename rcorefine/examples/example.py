"""Example of the paper: two models, settings, and a simulated record."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_choice, as_generator, as_number, as_whole
from ..data.measurement import Measurement
from ..data.signals import as_signals, check_finite
from ..exceptions import DataError
from ..systems import LinearModel, to_discrete
from ..systems.linear import Array

__all__ = ["Example"]


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """Example of the paper: initial model, true model, and settings.

    Attributes
    ----------
    name : str
        Short name.
    initial_model, true_model : LinearModel
        Continuous models before the refinement, and of the plant.
    dt : float
        Sampling time in s.
    settings : mapping
        Arguments of `RCORefiner` as in the paper: `order` (n_c), `window`
        (p), `markov` (mu), `learning_rate` and `static_learning_rate`
        (alpha of the two stages).
    initial_parameters, true_parameters : mapping of str to float
        Physical parameters of the two models.
    parameter_units : mapping of str to str
        Their units.
    input_units, output_units, state_units : tuple of str
        Units of the signals.
    description : str
        What the example is, and what had to be decided.

    Examples
    --------
    >>> from rcorefine import examples
    >>> example = examples.rlc()
    >>> example.record(n_samples=100, rng=np.random.default_rng(0)).n_samples
    100
    """

    name: str
    initial_model: LinearModel
    true_model: LinearModel
    dt: float
    settings: Mapping[str, float | int]
    initial_parameters: Mapping[str, float]
    true_parameters: Mapping[str, float]
    parameter_units: Mapping[str, str]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    state_units: tuple[str, ...]
    description: str

    @property
    def initial(self) -> ct.StateSpace:
        """Initial model, continuous, built anew on every call."""
        return self.initial_model.to_statespace()

    @property
    def true(self) -> ct.StateSpace:
        """True model, continuous, built anew on every call."""
        return self.true_model.to_statespace()

    def simulate(self, inputs: ArrayLike, model: str = "true") -> ct.TimeResponseData:
        """Simulate exactly, from rest, the input held between the samples.

        Parameters
        ----------
        inputs : array_like
            Input samples, shape (N,) or (1, N).
        model : {'true', 'initial'}, optional
            Which of the two models.

        Returns
        -------
        TimeResponseData
            Outputs and states (both of shape (signals, N)) over time in s.

        Raises
        ------
        control.ControlArgument
            If `model` is unknown.
        control.ControlDimension
            If `inputs` has another shape.
        """
        as_choice(model, "model", ("true", "initial"))
        w = as_signals(inputs, "inputs")
        if w.shape[0] != 1:
            raise ct.ControlDimension(f"inputs must have shape (N,) or (1, N), not {np.shape(inputs)}")
        check_finite(w, self.true_model.input_labels, None, "input")
        discrete = to_discrete(self.true_model if model == "true" else self.initial_model, self.dt)
        states = _states(discrete, w)
        return ct.TimeResponseData(
            np.arange(w.shape[1]) * self.dt,
            discrete.C @ states + discrete.D @ w,
            states,
            w,
            issiso=True,
            input_labels=list(discrete.input_labels),
            output_labels=list(discrete.output_labels),
            state_labels=list(discrete.state_labels),
            sysname=discrete.name,
        )

    def record(
        self,
        n_samples: int = 4000,
        *,
        noise: float = 0.0,
        rng: np.random.Generator | int = 0,
        amplitude: float = 1.0,
    ) -> Measurement:
        """Measure the true system under white Gaussian noise, from rest.

        Parameters
        ----------
        n_samples : int, optional
            Length of the record.
        noise : float, optional
            Standard deviation of white Gaussian noise on the output,
            relative to the standard deviation of the output.
        rng : Generator or int, optional
            Source of the random numbers, or a seed for one. The input is
            drawn first, so that it does not depend on `noise`.
        amplitude : float, optional
            Standard deviation of the input, in its unit.

        Returns
        -------
        Measurement
            The record; its input is held between the samples.

        Raises
        ------
        DataError
            If `n_samples` is below 2, `noise` is negative, or
            `amplitude` is not positive.
        """
        n_samples = as_whole(n_samples, "n_samples", least=2, error=DataError)
        noise = as_number(noise, "noise", least=0.0, error=DataError)
        amplitude = as_number(amplitude, "amplitude", above=0.0, error=DataError)
        generator = as_generator(rng)
        w = amplitude * generator.standard_normal((1, n_samples))
        discrete = to_discrete(self.true_model, self.dt)
        y = discrete.C @ _states(discrete, w) + discrete.D @ w
        if noise > 0.0:
            y = y + noise * y.std(axis=1, keepdims=True) * generator.standard_normal(y.shape)
        return Measurement(
            w,
            y,
            dt=self.dt,
            hold="zoh",
            input_labels=list(self.true_model.input_labels),
            output_labels=list(self.true_model.output_labels),
            input_units=list(self.input_units),
            output_units=list(self.output_units),
            name=self.name,
        )

    def __str__(self) -> str:
        """Table of the parameters, initial and true."""
        width = max(len(key) for key in self.true_parameters)
        lines = [f"{self.name}, sampled every {1e3 * self.dt:g} ms", self.description, ""]
        lines.append(f"{'':{width}}  {'initial':>10}  {'true':>10}")
        for key, true in self.true_parameters.items():
            initial, unit = self.initial_parameters[key], self.parameter_units[key]
            lines.append(f"{key:{width}}  {initial:>10.6g}  {true:>10.6g}  {unit}")
        settings = "settings: " + ", ".join(f"{key} {value:g}" for key, value in self.settings.items())
        lines += textwrap.wrap(settings, 80)
        return "\n".join(lines)


def _states(model: LinearModel, w: Array) -> Array:
    """States from rest at every sample, shape (n, N)."""
    forced = model.B @ w
    states = np.zeros((model.n_states, w.shape[1]))
    for k in range(w.shape[1] - 1):
        states[:, k + 1] = model.A @ states[:, k] + forced[:, k]
    return states
