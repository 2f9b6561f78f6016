"""Result of a diagnosis, in figures and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..exceptions import IdentifiabilityWarning, ModelError, unheard
from ..inference.f_tests import FTest
from ..inference.levels import levels
from ..inference.parameters import EstimatedParameter
from ..inference.refinement import Refinement
from ..results import Look, Options, ReportedModel, Result, Row, picture, show, with_error
from ..systems.linear import Array
from .check_rows import CheckRow, Detectable
from .noise import ErrorShare
from .open_law import HiddenForce, OpenLaw, hidden_force
from .words import sentences

if TYPE_CHECKING:
    from .experiments import ExperimentAdvice


_EXCLUDED = 0.01  # probability below which a place is none


@dataclass(frozen=True, slots=True, eq=False)
class RankedEffect(Row):
    """One row of `Diagnosis.ranking`.

    Attributes
    ----------
    effect : Effect
        Kind and place.
    coefficients, std : dict
        Coefficient and standard deviation by name, in the model's units.
    fit_before, fit_after : float
        Fit in percent without and with it, on the validation record if one was given;
        the mean over the outputs.
    p_value : float
        Of its score, if nothing were missing.
    probability : float
        Of this hypothesis, special cases of the same law counted in; all rows, `Diagnosis.none_of_these` and
        "nothing is missing" sum to one. NaN where the verdict is "unexplained": then it is none of them.
    log_likelihood_gain : float
        Log marginal likelihood over that of the model as it is.
    refinement : Refinement
        Model with this effect, refitted.
    beside : tuple of Effect
        Other effects of the same hypothesis: `refinement` holds them all.
    alike : bool
        Whether the records cannot distinguish it from the best one; the best one itself is.
    same : tuple of RankedEffect
        The same change of the model under other names: no record of these inputs and outputs distinguishes
        them. Their probability is included.
    """

    effect: Effect
    coefficients: dict[str, float]
    std: dict[str, float]
    fit_before: float
    fit_after: float
    p_value: float
    probability: float
    log_likelihood_gain: float
    refinement: Refinement
    beside: tuple[Effect, ...] = ()
    alike: bool = False
    same: tuple[RankedEffect, ...] = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """All effects of this hypothesis, the surest one first."""
        return (self.effect, *self.beside)

    @property
    def label(self) -> str:
        """Names of all its effects, and what else they may be called."""
        # own effects, then other names of the same change
        own = " + ".join(effect.label for effect in self.effects)
        return " = ".join([own, *(row.label for row in self.same)])

    @property
    def estimates(self) -> list[tuple[Effect, dict[str, EstimatedParameter]]]:
        """Each effect with the rows of its coefficients by name."""
        # rows of the refinement, by effect and coefficient
        rows = [row for row in self.refinement.parameters if row.role == "effect"]
        return [
            (e, {row.name: row for row in rows if (row.kind, row.place) == (e.kind, e.place)})
            for e in self.effects
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis(Result):
    """Which physical effect is missing, and how sure that is.

    Attributes
    ----------
    verdict : str
        "adequate" (nothing is missing that this record could show), "parameters" (moved
        numbers of the model explain the record, which shows no need for a law), "effect" (one of the
        candidates is), "ambiguous" (several explain it alike, or the best one and a force of no
        law), "unexplained" (something is missing that none of the candidates explains).
    ranking : tuple of RankedEffect
        Candidates that were refitted, the most probable first.
    ambiguous : tuple of Effect
        Effects that this record cannot tell from the best one, the best and its other names included. Of
        sets of effects: those of the tied sets that the best set does not have. Rows of `ranking` that are
        tied are `alike`.
    tests : tuple of FTest
        Tests of the model as it is; each has name, statistic, p_value.
    winner_tests : tuple of FTest
        The same with the best effect added, empty where none was tried.
    detectable : tuple of Detectable
        Where the verdict is "adequate": what the record would have shown.
    base : Refinement
        Model before anything is added, its free parameters fitted.
    records : tuple of Measurement
        What it rests on.
    significance : float
        Level of the gate.
    force_ratio : float
        Unmeasured force over the measured one that the residual speaks of, 0 for none.
    settings : dict
        Options of `diagnose`.
    notes : tuple of str
        What else was noticed.
    floated : Refinement or None
        The model with its numbers fitted, where the verdict is "parameters".
    none_of_these : float
        Probability of a force that follows none of the laws, at the best one's place or, where an unmeasured
        force is allowed for, at no known place; 1 where the verdict is "unexplained", NaN where nothing was
        ranked. Departures from the best law up to its
        own size count alike, whether this record would have shown them or not.
    places : dict
        Probability of each place, the most probable first, from its candidates and the free force or static
        curve fitted there. Inputs and outputs count as places. The sum is below one by the probability that
        the place is unknown: an unmeasured force, or the share of the error that the likeliest place leaves.
        Empty where nothing was ranked.
    open_law : OpenLaw or None
        Where the verdict is "unexplained": the force as a table, and the laws nearest to it.
    left_to_noise : str
        What the model of the verdict leaves to colored noise, and what that may hide. Empty where that is
        little, or where the residual tests of an unexplained record are significant.
    checks : tuple of CheckRow
        What `check` finds odd about the records, or the model beside them, before anything is tested.
    error_shares : tuple of ErrorShare
        What the model of the verdict leaves of each output, and how much of that is no noise. Empty for
        frequency responses and where an unmeasured force is allowed for.
    adequate_to : float
        Largest error of the model, as a share of the spread of its output, where the tests find an error
        that is too small to matter (`matters` of `diagnose`). Such a verdict has no probability. Else NaN.
    """

    verdict: str
    ranking: tuple[RankedEffect, ...]
    ambiguous: tuple[Effect, ...]
    tests: tuple[FTest, ...]
    winner_tests: tuple[FTest, ...]
    detectable: tuple[Detectable, ...]
    base: Refinement
    records: tuple[Measurement, ...]
    significance: float
    force_ratio: float
    settings: dict[str, Any]
    notes: tuple[str, ...] = ()
    floated: Refinement | None = None

    @property
    def parameters(self) -> tuple[EstimatedParameter, ...]:
        """Re-estimated parameters of the model with their standard errors.

        They are empty unless the verdict is "parameters".
        """
        # only the re-estimated parameters of the model
        return () if self.floated is None else tuple(r for r in self.floated.parameters if r.role == "linear")

    none_of_these: float = np.nan
    places: dict[str, float] = field(default_factory=dict)
    open_law: OpenLaw | None = None
    left_to_noise: str = ""
    checks: tuple[CheckRow, ...] = ()
    error_shares: tuple[ErrorShare, ...] = ()
    adequate_to: float = np.nan

    @property
    def place(self) -> str | None:
        """Place of the missing effect, or None.

        It is None where nothing was ranked or no place is likely.
        """
        # places are sorted: the first is the most probable
        place, probability = next(iter(self.places.items()), (None, 0.0))
        return place if probability >= _EXCLUDED else None

    @property
    def hidden_force(self) -> HiddenForce | None:
        """Unknown force at `place` over the first record.

        It needs no force law. It is None for frequency responses, and where no force can act at the place.
        """
        # smoothed force at the place of the largest probability
        model = self.base.physical_model
        if self.base.of_responses:
            return None
        port = next((port for port in model.ports if port.name == self.place), None)
        if port is None or self.best is None:
            return None
        noise = self.best.refinement.rmse if self.open_law is None else self.open_law.rmse
        return hidden_force(self.base, noise, port, self.ordered_records()[0])

    def law(self) -> Effect:
        """Return the tabulated force or curve that no candidate explains.

        The effect can be given to `refine` or `compare`.

        Returns
        -------
        Effect
            Of kind ``"tabulated"``, named ``"unknown force, tabulated at PLACE"``; its scale is 1. For an
            input or an output of kind ``"input_curve"`` or ``"output_curve"``: ``"unknown curve, ..."``.

        Raises
        ------
        ModelError
            If there is none: the effect has a name, nothing is missing, or no table reduces the error of the
            free run.
        """
        # a table exists only where no candidate explains the record
        if self.open_law is None:
            reason = "no table of a force over position and velocity, or of a channel, reduces the error"
            if self.verdict != "unexplained":
                reason = f"the verdict is {self.verdict!r}: no unknown force; refine() takes what was found"
            raise ModelError(reason)
        return self.open_law.effect

    @property
    def legend(self) -> str:
        """Meaning of the columns of the table."""
        return (
            "value, std: coefficient and its standard deviation. fit: of the simulation, in percent. "
            "p-value: probability of a score as high as that of this effect if nothing is missing. P: "
            "probability of the row, compared with all others, with no effect and with changed parameters."
        )

    @property
    def best(self) -> RankedEffect | None:
        """First row of the ranking, None where nothing was needed or tried."""
        # rows are sorted by probability
        return self.ranking[0] if self.ranking else None

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Missing effects of the best candidate, the most certain first.

        They are empty where none is named.
        """
        # effects count only where the verdict names them
        if self.best is None or self.verdict not in ("effect", "ambiguous"):
            return ()
        return self.best.effects

    def refine(self) -> Refinement:
        """Fit the model with the best set of effects to convergence.

        The fit starts from the values of the ranking.

        Returns
        -------
        Refinement
            The base model itself where the verdict is "adequate", with its numbers fitted where
            it is "parameters". Its mean fit is not below that of the first row on the same records.
        """
        from ..refinement.refine import refit

        # parameters: the fit with priors; nothing missing: the model as it is
        if self.floated is not None:
            return self.floated
        if self.best is None:
            return self.base
        # fit the best set to convergence on the records of the diagnosis
        settings = {k: self.settings[k] for k in ("tolerance", "offset", "noise", "horizon")}
        ranked = self.best.refinement
        with unheard(IdentifiabilityWarning):  # the sentences name what the records leave open
            polished = refit(ranked, list(self.records), elsewhere=False, **settings)
        # priors and weights may trade one output for another: what was shown is not given away
        return polished if np.mean(polished.fit) >= np.mean(ranked.fit) else ranked

    def suggest_experiment(
        self,
        *,
        probability: float = 0.9,
        repeat: bool = True,
        amplitudes: Sequence[float] = (0.3, 2.0, 3.0),
        lengths: Sequence[float] = (2.0, 4.0),
        bands: Sequence[tuple[float, float]] | None = None,
        sensors: Sequence[str] | None = None,
        costs: Mapping[str, float] | None = None,
        largest_input: ArrayLike | None = None,
    ) -> ExperimentAdvice:
        """Return the cheapest experiment that distinguishes the candidates.

        Every candidate is simulated under every option and every other candidate is refitted to
        it; what then still differs, over the noise of this record, gives the probability
        that the true one stands alone.

        Parameters
        ----------
        probability : float
            Probability that is enough.
        repeat : bool
            Whether to consider a plain repetition.
        amplitudes : sequence of float
            Factors on the input.
        lengths : sequence of float
            Lengths over that of this record.
        bands : sequence of (float, float), optional
            Other bands of excitation in rad/s, at the rms of this record's input; default
            the two halves of the band where the model lives, and its lowest modes.
        sensors : sequence of str, optional
            States or ports where a sensor could be added, with the relative noise of the
            present ones; default every state of their sort that is not measured yet.
        costs : dict, optional
            Cost by kind of experiment, in lengths of this record: default ``repeat`` 1,
            ``amplitude`` 1.5, ``band`` 2, ``longer`` 1 (times the length), ``sensor`` 6.
        largest_input : float or array_like of shape (n_w,), optional
            What the actuator can do; options beyond are not possible.

        Returns
        -------
        ExperimentAdvice
            Options with probability and cost, the chosen one, warnings. With nothing to
            separate its `chosen` is None and its message says why.

        Raises
        ------
        ModelError
            If the diagnosis rests on frequency responses.
        control.ControlArgument
            If an option is out of its range, or a place does not exist.

        Notes
        -----
        With D the squared distance between the outputs of two candidates after one is
        refitted to the other, over the noise, and L what this record says already, they
        separate with probability Phi((L + D - 9.2) / (2 sqrt(D))); what the spread of the
        coefficients adds is drawn. The sensor is judged by the new record alone. Of
        several records the first is varied, and all of them count.

        Examples
        --------
        >>> import numpy as np, rcorefine as rco
        >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
        >>> rng = np.random.default_rng(0)
        >>> force = 10 * rng.standard_normal(2000)
        >>> blank = rco.Measurement(force, np.zeros(2000), dt=0.02)
        >>> y = rco.simulate(model, blank, "zero").outputs[0]
        >>> noisy = y + 0.03 * y.std() * rng.standard_normal(2000)
        >>> found = rco.diagnose(model, rco.Measurement(force, noisy, dt=0.02))
        >>> print(found.suggest_experiment().message)
        Nothing to separate: no test fires, and no candidate comes near.
        """
        from .experiments import suggest

        # experiments are simulated over time
        if self.base.of_responses:
            raise ModelError(
                "experiments are planned for records in time; of frequency responses more outputs, a wider "
                "band or other amplitudes tell candidates apart"
            )
        return suggest(
            self, probability, costs, largest_input, repeat=repeat, amplitudes=amplitudes, lengths=lengths,
            bands=bands, sensors=sensors,
        )  # fmt: skip

    def ordered_records(self) -> list[Measurement]:
        """The records, channels in the order of the model.

        Returns
        -------
        list of Measurement
        """
        from ..models.operating_point import ordered_record

        # channels in the order of the model
        return [ordered_record(self.base.physical_model, r) for r in self.records]

    def sentences(self) -> list[str]:
        """Return the findings, one sentence each.

        Returns
        -------
        list of str
        """
        return sentences(self)

    @picture
    def plot(self, **options: Unpack[Look]) -> ct.ControlPlot:
        """Ranking, hidden force against motion, residual before and after.

        Of frequency responses: ranking, residual over the noise, magnitude and phase, before and after.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)


@dataclass(frozen=True, slots=True, eq=False)
class Step(Row):
    """One step of the improvement.

    Attributes
    ----------
    effect : Effect or None
        Added effect; None for the start, and where only parameters were re-estimated.
    action : str
        "start", "parameters" (the parameters are re-estimated from here on), "add", "pair" (added
        together with the row before), "swap", "drop".
    train_rmse, choice_rmse, validation_rmse : ndarray, shape (n_y,)
        Root mean square error of the free run on the part that was fitted, on the part
        on which the step was chosen, and on the held-out data.
    coefficients, std : dict
        Of the effect, after all effects of this step were fitted together.
    verdict : str
        Verdict of the diagnosis that led to this step; for the last one see
        `Improvement.verdict`.
    rivals : tuple of Effect
        Effects that the data cannot distinguish from it.
    refinement : Refinement
        Model after this step.
    """

    effect: Effect | None
    action: str
    train_rmse: Array
    choice_rmse: Array
    validation_rmse: Array
    coefficients: dict[str, float]
    std: dict[str, float]
    verdict: str
    rivals: tuple[Effect, ...]
    refinement: Refinement

    @property
    def name(self) -> str:
        """Action of the step, in words."""
        # the first step is the initial model
        if self.effect is None:
            return "initial model" if self.action == "start" else self.action
        return f"{self.action} {self.effect.label}"


@dataclass(frozen=True, slots=True, eq=False)
class Improvement(ReportedModel):
    """Steps from the initial model to the improved one.

    Attributes
    ----------
    steps : tuple of Step
        The start, then one row per effect that earned its place.
    verdict : str
        Verdict on the last model: "adequate", or "unexplained" where `diagnose` names nothing.
    message : str
        Why it ended, in words.
    output_labels, output_units : tuple of str
        Names and units of the outputs, units "" where unknown.
    notes : tuple of str
        What was noticed about the record: its parts, its hold.
    checks : tuple of CheckRow
        What `check` finds odd about the records, or the first model beside them.
    error_shares : tuple of ErrorShare
        What the last model leaves of each output on the held-out data, and how much of that is no noise.
        Empty for frequency responses.
    diagnosis : Diagnosis or None
        Diagnosis of the same records, which chose the set: verdict, ranking and tests.
    """

    steps: tuple[Step, ...]
    verdict: str
    message: str
    output_labels: tuple[str, ...]
    output_units: tuple[str, ...]
    notes: tuple[str, ...] = ()
    checks: tuple[CheckRow, ...] = ()
    error_shares: tuple[ErrorShare, ...] = ()
    diagnosis: Diagnosis | None = None

    @property
    def refinement(self) -> Refinement:
        """Model after the last step.

        Its `hold` is the one that was found to suit the inputs.
        """
        return self.steps[-1].refinement

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects in the last model that were asked for."""
        return asked_effects(self.refinement)

    def sentences(self) -> list[str]:
        """Return the steps and the outcome, one sentence each.

        Returns
        -------
        list of str
        """
        # change of the held-out error at each output
        first, last = self.steps[0], self.steps[-1]
        lines = []
        for i, label in enumerate(self.output_labels):
            before, after = first.validation_rmse[i], last.validation_rmse[i]
            unit = f" {self.output_units[i]}" if self.output_units[i] else ""
            fell = f" -> {after:.4g}{unit} ({100 * (after / before - 1):+.0f} %)" if before > 0 else unit
            error = f"{before:.4g}{fell if len(self.steps) > 1 else unit}"
            lines.append(f"Error of {label} on held-out data: {error}.")
        # alternatives of each step
        for i, step in enumerate(self.steps):
            if step.effect is not None and step.rivals and step.action != "drop":
                others = ", ".join(effect.label for effect in step.rivals)
                lines.append(f"Step {i}: the data cannot distinguish {step.effect.label} from {others}.")
        lines.append(self.message)
        return [*lines, *self._estimates(), *self.notes]

    def _estimates(self) -> list[str]:
        """Return a sentence on the estimates of the last model.

        Offsets are among them where they differ from zero. The list is empty where the table holds all.
        """
        # a single effect already stands in the table
        every, least = self.refinement.parameters, levels().moved
        rows = [r for r in every if r.role != "offset" or abs(r.coefficient) > least * r.std]
        if len(rows) < 2 and all(row.role == "effect" for row in rows):
            return []
        told = [f"{r.name} at {r.place} {r.initial:g} -> {with_error(r.value, r.std, r.unit)}" for r in rows]
        return [f"Estimates of the last model, initial -> value +/- std: {'; '.join(told)}."]

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """The staircase of held-out error, the effect's name on each step.

        Parameters
        ----------
        ax : Axes, optional
            Where to draw.
        label : str, optional
            Label of the held-out line.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)


def asked_effects(model: Refinement) -> tuple[Effect, ...]:
    """Return the effects of a model, without linear parameters and offsets."""
    return tuple(e for e, role in zip(model.effects, model.roles, strict=True) if role == "effect")


def next_step(found: Diagnosis | Improvement) -> str:
    """Return the next step after a verdict, as a line of Python.

    The line calls the result ``found``.

    Parameters
    ----------
    found : Diagnosis or Improvement
        Result.

    Returns
    -------
    str
    """
    # one line of Python that goes on from the verdict
    better = "better = found.refine(); print(better)"
    if isinstance(found, Improvement):
        return better.replace("refine()", "refinement") if len(found.steps) > 1 else "found.plot()"
    if found.verdict == "adequate" and found.left_to_noise:  # numbers that are far off leave the same
        return 'print(rco.refine(found.base, found.records, free="linear", tolerance=0.5))'
    if found.verdict == "adequate":
        return "rco.compare(found.base, found.records[0]).plot()  # what is left to noise"
    if found.verdict == "ambiguous" and not found.base.of_responses:
        return "print(found.suggest_experiment())"
    if found.verdict != "unexplained":
        return better
    if found.open_law is not None:
        return "print(rco.refine(found.base, found.records, [found.law()]))"
    return "found.plot()  # the force against the motion, and what is left over"
