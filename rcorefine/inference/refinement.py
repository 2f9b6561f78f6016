"""The refined model: what `refine` returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_text, as_vector, as_whole
from ..data.channels import resting_inputs
from ..data.measurement import Measurement
from ..data.records import as_data
from ..effects.effect import Effect
from ..engine.controlled import checked_horizon
from ..engine.nonlinear import nonlinear_system
from ..engine.simulation import simulate
from ..engine.structure import Structure
from ..exceptions import ModelError
from ..export.programs import CodeExports
from ..models.physical_model import PhysicalModel
from ..results import Options, ReportedModel, picture, show, views
from ..systems.linear import Array
from .parameters import EstimatedParameter


@dataclass(frozen=True, slots=True, eq=False)
class Refinement(ReportedModel, CodeExports):
    """A model refined with effects, and how well it is known.

    Passes as a model to `compare`, `refine` and the other functions.

    Attributes
    ----------
    physical_model : PhysicalModel
        Initial model.
    records : tuple of Measurement or FrequencyResponse
        Records that were fitted, as they were given.
    effects : tuple of Effect
        Effects that were added, linear parameters and offsets included.
    roles : tuple of str
        Role of each effect: "effect", "linear", "offset", or "known" where the controller declares it.
    theta : ndarray, shape (p,)
        Coefficients in the order of `parameters`.
    parameters : tuple of EstimatedParameter
        Rows: name, kind, place, initial, value, std, unit, role, prior, bounds.
    covariance : ndarray, shape (p, p)
        Covariance of `theta`, robust to coloured residuals.
    fit, rmse : ndarray, shape (n_y,)
        On the records that were fitted: ``100 (1 - |y - yh| / |y - mean y|)`` in percent,
        and the root mean square error in units of each output.
    initial_fit : ndarray, shape (n_y,)
        Fit of the initial model on the same records, initial state estimated too.
    initial_states : ndarray, shape (n_windows, n)
        Initial state of each record or window.
    constants : dict
        Smoothing width of each law that has one, by the index of its effect.
    substeps : int
        Substeps per sample with which the model is simulated.
    residual_orders : tuple of int
        Order of the autoregressive model of each output's residual; 0 for a white one.
    success : bool
        Whether the estimate converged to a finite minimum.
    message : str
        What happened, in words.
    warnings : tuple of str
        What the records cannot see, one sentence each.
    led : bool
        Whether the initial model is unstable over such records, so that fit and rmse are those of what
        is predicted one sample ahead.
    of_responses : bool
        Whether it was fitted to frequency responses: fit and rmse are those of complex points.
    """

    # model with its effects
    physical_model: PhysicalModel
    records: tuple[Any, ...]
    effects: tuple[Effect, ...]
    roles: tuple[str, ...]
    constants: dict[int, float]
    # estimates
    theta: Array
    parameters: tuple[EstimatedParameter, ...]
    covariance: Array
    fit: Array
    # quality on the records
    rmse: Array
    initial_fit: Array
    initial_states: Array
    # simulation
    substeps: int
    residual_orders: tuple[int, ...]
    # outcome of the fit
    success: bool
    message: str
    warnings: tuple[str, ...] = ()
    led: bool = False
    of_responses: bool = False

    # ------------------------------------------------------------------ the model
    def simulation_structure(self) -> tuple[Structure, Array, int]:
        """Structure, coefficients and substeps for the simulation engine.

        Returns
        -------
        structure : Structure
            Initial model in feedback with the effects.
        theta : ndarray, shape (p,)
            Coefficients.
        substeps : int
            Substeps per sample.
        """
        # initial model in feedback with the effects
        structure = Structure(self.physical_model, self.effects, constants=self.constants)
        return structure, self.theta, self.substeps

    @property
    def system(self) -> ct.StateSpace:
        """Refined linear model: the initial one with the linear effects absorbed."""
        structure, theta, _ = self.simulation_structure()
        return structure.system(theta, name=f"{self.physical_model.linear.name}_refined")

    @property
    def nonlinear(self) -> ct.NonlinearIOSystem:
        """Refined model with its nonlinear effects, continuous time.

        Raises
        ------
        ModelError
            If an effect has no continuous-time state equation (a delay).
        """
        structure, theta, _ = self.simulation_structure()
        return nonlinear_system(structure, theta, name=f"{self.physical_model.linear.name}_refined")

    def linearize(self, states: ArrayLike, inputs: ArrayLike) -> ct.StateSpace:
        """The refined model about any point, nonlinear effects included.

        Parameters
        ----------
        states : array_like of shape (n,)
            States, those of laws with memory behind, in units of the model; absolute ones.
        inputs : array_like of shape (n_w,)
            Inputs.

        Returns
        -------
        StateSpace
            For Bode plots and design: `control.linearize` of `nonlinear`, labels kept.
        """
        system = self.nonlinear
        x, u = as_vector(states, "states", system.nstates), as_vector(inputs, "inputs", system.ninputs)
        # numerical linearization by python-control
        linear = ct.linearize(system, x, u)
        linear.update_names(
            name=f"{self.physical_model.name}_linearized",
            inputs=system.input_labels, outputs=system.output_labels, states=system.state_labels,
        )  # fmt: skip
        return linear

    @property
    def ports(self) -> tuple[Any, ...]:
        """Ports of the initial model."""
        return self.physical_model.ports

    @property
    def hold(self) -> str | None:
        """Hold that was found to suit the inputs.

        It replaces the hold that a record declares, and is None where none was sought.
        """
        return self.physical_model.hold

    def with_hold(self, hold: str | None) -> Refinement:
        """Return the refinement with another hold of the inputs.

        The coefficients do not change.

        Parameters
        ----------
        hold : {"zoh", "foh", "bandlimited"} or None
            The model's own, or None for what each record declares. Nothing is fitted again.

        Returns
        -------
        Refinement
        """
        return replace(self, physical_model=replace(self.physical_model, hold=hold))

    def simulate(self, data: Measurement, x0: Any = "estimate") -> ct.TimeResponseData:
        """Free run over a record.

        Parameters
        ----------
        data : Measurement
            Record; its outputs are used for the initial state only.
        x0 : {"estimate", "zero"} or ndarray of shape (n,)
            Initial state.

        Returns
        -------
        TimeResponseData
            Outputs and states of the refined model, labels kept.
        """
        # outputs of the record serve only to estimate the initial state
        run = simulate(self, data, x0)
        structure, _, _ = self.simulation_structure()
        linear = self.physical_model.linear
        return ct.TimeResponseData(
            data.timepts,
            run.outputs,
            run.states,
            resting_inputs(data, linear.input_labels).inputs,
            input_labels=list(linear.input_labels),
            output_labels=list(linear.output_labels),
            state_labels=structure.state_labels(),
            sysname=f"{linear.name}_refined",
            issiso=False,
        )

    def parameter(self, name: str, place: str | None = None) -> EstimatedParameter:
        """Return one row of `parameters` by name or kind.

        Give the place, too, where several rows share the name.

        Parameters
        ----------
        name : str
            Name of the parameter, or kind of the effect.
        place : str, optional
            Place.

        Returns
        -------
        EstimatedParameter

        Raises
        ------
        ModelError
            If none or several rows fit.
        """
        as_text(name, "name")
        if place is not None:
            as_text(place, "place")
        # rows with this name or kind, at the place if given
        rows = [
            row
            for row in self.parameters
            if name in (row.name, row.kind) and (place is None or row.place == place)
        ]
        if len(rows) != 1:
            known = ", ".join(f"{row.name} ({row.place})" for row in self.parameters)
            raise ModelError(f"{len(rows)} parameters match {name!r} at {place!r}; there are {known}")
        return rows[0]

    @picture
    def plot(self, data: Any = None, **options: Unpack[Options]) -> ct.ControlPlot:
        """Draw a record, the initial and the refined model, and the residuals.

        Of a frequency response: magnitude, phase and relative error.

        Parameters
        ----------
        data : Measurement or FrequencyResponse, optional
            Record; default the first of `records`.
        ax : array of Axes, optional
            Axes to draw in, as in `compare(...).plot()`.
        label : list of str, optional
            Labels of the two models.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", data, **options)

    @picture
    def bode_plot(
        self,
        measured: Any = None,
        omega: ArrayLike | None = None,
        *,
        levels: Sequence[float] | None = None,
        **options: Unpack[Options],
    ) -> ct.ControlPlot:
        """Plot the frequency responses of the initial and the refined model.

        The measured response is drawn beside them if it is given. The band about the refined curve is two
        standard deviations of the response, from the covariance of the estimates.

        Parameters
        ----------
        measured : Measurement or FrequencyResponse, optional
            Record, or its frequency response; drawn as dots with a band, and
            a row with the relative error of both models is added.
        omega : array_like of shape (n_omega,), optional
            Frequencies in rad/s.
        levels : sequence of float, optional
            Peaks of a sine at the input: draws the response with all effects at each of them
            (`frequency_response_at`), beside the measured response at the levels of the record.
        ax : array of Axes, optional
            Axes to draw in, shape (2 n_y, n_w); with `measured` and without `levels` (3 n_y, n_w).
        label : list of str, optional
            Labels of the two models, or of the levels.

        Returns
        -------
        ControlPlot
            Lines, axes, figure. Without `levels` nonlinear effects are not in it: the refined
            curve is that of `system`.
        """
        return show(self, "bode_plot", measured, omega, levels=levels, **options)

    @picture
    def response_plot(
        self, kind: str = "step", *, count: int = 200, seed: int = 0, **options: Unpack[Options]
    ) -> ct.ControlPlot:
        """Plot step responses, poles and zeros, or Nyquist curves.

        The initial and the refined model are drawn, with the uncertainty of the refined one.

        Parameters
        ----------
        kind : {"step", "poles", "nyquist"}
            "step": unit steps of each input, with a band that holds 95 % of the drawn responses at each
            time. "poles": poles (x), and zeros (o) of each channel. "nyquist": the response at positive
            frequencies, with the point -1.
        count : int
            Number of models drawn from the normal distribution of the estimates (`covariance`). Estimates
            that the record does not determine keep their value.
        seed : int
            Seed of the draws.
        ax : array of Axes, optional
            Axes to draw in, shape (n_y, n_w), for "poles" (1, 1).
        label : list of str, optional
            Labels of the two models.

        Returns
        -------
        ControlPlot
            Lines, axes, figure. Nonlinear effects are not in it: the refined curve is that of `system`.

        Raises
        ------
        control.ControlArgument
            If `kind` is unknown.

        Examples
        --------
        >>> import numpy as np, rcorefine as rco
        >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
        >>> rng = np.random.default_rng(0)
        >>> force, noise = rng.standard_normal((2, 500))
        >>> data = rco.Measurement(force, noise, dt=0.02, input_labels="force")
        >>> y = rco.simulate(model, data, "zero").outputs + 1e-3 * noise
        >>> data = rco.Measurement(force, y, dt=0.02, input_labels="force")
        >>> better = rco.refine(model, data, [rco.Effect("stiffness", "link1")])
        >>> better.response_plot("poles").axes.shape
        (1, 1)
        """
        return show(self, "response_plot", kind, count=count, seed=seed, **options)

    def drawn(self, count: int, seed: int = 0) -> list[ct.StateSpace]:
        """Return linear models drawn from the distribution of the estimates.

        Parameters
        ----------
        count : int
            Number of models.
        seed : int
            Seed of the draws.

        Returns
        -------
        list of StateSpace
        """
        count, rng = as_whole(count, "count", least=0), np.random.default_rng(as_whole(seed, "seed", least=0))
        structure, theta, _ = self.simulation_structure()
        # coefficients without a finite variance keep their estimates
        known = np.isfinite(np.diag(self.covariance))
        lower, upper = np.array([(q.lower, q.upper) for q in structure.parameters]).reshape(-1, 2).T
        points = np.tile(theta, (count, 1))
        if known.any():
            C = self.covariance[np.ix_(known, known)]
            # normal distribution of the estimates, clipped to the bounds
            points[:, known] += rng.multivariate_normal(np.zeros(len(C)), C, size=count, check_valid="ignore")
        return [structure.system(point) for point in np.clip(points, lower, upper)]

    def script(self, data: Measurement | None = None, *, horizon: float | None = None) -> str:
        """Return a Python program that makes this refinement again.

        It defines the initial model, reads the record from a file, and fits the effects from their present
        values; what is held in them stays held.

        Parameters
        ----------
        data : Measurement or FrequencyResponse, optional
            Record, whose signals the program verifies.
        horizon : float, optional
            Length in s of the free runs, as it was given to `refine`.

        Returns
        -------
        str

        Raises
        ------
        control.ControlArgument
            If `data` is no record, or `horizon` no positive number.

        Examples
        --------
        >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0])
        >>> force = np.random.default_rng(0).standard_normal(200)
        >>> y = rco.simulate(model, rco.Measurement(force, np.zeros(200), dt=0.02), "zero").outputs[0]
        >>> data = rco.Measurement(force, y, dt=0.02)
        >>> found = rco.refine(model, data, [rco.Effect("damping", "link1")])
        >>> found.script(data).splitlines()[-1]
        'print(better)'
        """
        if data is not None:
            as_data(data, several=False)
        checked_horizon(horizon, known_start=False)
        return str(views().refinement_script(self, data, horizon))

    # ------------------------------------------------------------------ in words
    def sentences(self) -> list[str]:
        """Return the meaning of the results, one sentence per entry.

        Returns
        -------
        list of str
        """
        # answer, meaning of std, message of the fit
        what = "frequency response" if self.of_responses else "prediction" if self.led else "simulation"
        lines = [
            f"The {what} explains {_percent(self.fit, self.fit)} of the "
            f"{'measured one' if self.of_responses else 'record'} "
            f"(initial model {_percent(self.initial_fit, self.fit)}).",
            "std is the standard deviation over repeated records"
            + (
                ", for white residuals."
                if not any(self.residual_orders)
                else f". It allows for the colored residuals (AR order {max(self.residual_orders)})."
            ),
            self.message,
        ]
        if any(row.is_known for row in self.parameters):
            lines.insert(2, "prior is the standard deviation of what is known about a value beforehand.")
        if self.hold is not None:
            lines.append(f"All inputs use hold={self.hold!r}, whatever a record declares.")
        # reasons not to trust the estimate are in its message already
        return lines + [f"Warning: {said}." for said in self.warnings if said not in self.message]


def percent(fit: float, reached: float) -> str:
    """Return a fit as text, also that of a constant output or a divergence.

    Either is NaN. A fit is that of a divergence if the fit that was reached in the end is a number.
    """
    if not np.isnan(fit):
        return f"{fit:.4g} %"
    return "- (constant)" if np.isnan(reached) else "diverges"


def _percent(fit: Array, reached: Array) -> str:
    return " / ".join(map(percent, np.atleast_1d(fit), np.atleast_1d(reached)))
