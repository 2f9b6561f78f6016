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
from ..inference.refinement import EstimatedParameter, Refinement
from ..results import Look, Reported, Row, picture, show
from .checks.row import CheckRow
from .hidden_force import HiddenForce, hidden_force
from .open_law import OpenLaw
from .words import sentences

if TYPE_CHECKING:
    from .experiment_design.result import ExperimentAdvice

__all__ = ["Detectable", "Diagnosis", "RankedEffect"]

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

    @property
    def effects(self) -> tuple[Effect, ...]:
        """All effects of this hypothesis, the surest one first."""
        return (self.effect, *self.beside)

    @property
    def label(self) -> str:
        """Names of all its effects."""
        return " + ".join(effect.label for effect in self.effects)

    @property
    def estimates(self) -> list[tuple[Effect, dict[str, EstimatedParameter]]]:
        """Each effect with the rows of its coefficients by name."""
        rows = self.refinement.parameters
        return [
            (e, {r.name: r for r in rows if (r.kind, r.place, r.role) == (e.kind, e.place, "effect")})
            for e in self.effects
        ]


@dataclass(frozen=True, slots=True)
class Detectable(Row):
    """Smallest coefficient of an effect that the record would have shown.

    The power of detection is 95 %.
    """

    effect: Effect
    coefficient: str
    smallest: float
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis(Reported):
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
        Effects that this record cannot tell from the best one, the best included. Of sets of effects: those
        of the tied sets that the best set does not have. Rows of `ranking` that are tied are `alike`.
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
        Where no test fires on the model as it is, though much of the record is left to noise with a
        memory: how much, and what that may hide. Else empty.
    checks : tuple of CheckRow
        What `check` finds odd about the records, or the model beside them, before anything is tested.
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
        return () if self.floated is None else tuple(r for r in self.floated.parameters if r.role == "linear")

    none_of_these: float = np.nan
    places: dict[str, float] = field(default_factory=dict)
    open_law: OpenLaw | None = None
    left_to_noise: str = ""
    checks: tuple[CheckRow, ...] = ()

    @property
    def place(self) -> str | None:
        """Place of the missing effect, or None.

        It is None where nothing was ranked or no place is likely.
        """
        place, probability = next(iter(self.places.items()), (None, 0.0))
        return place if probability >= _EXCLUDED else None

    @property
    def hidden_force(self) -> HiddenForce | None:
        """Unknown force at `place` over the first record.

        It needs no force law. It is None for frequency responses, and where no force can act at the place.
        """
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
        if self.open_law is None:
            if self.verdict != "unexplained":
                raise ModelError(
                    f"the verdict is {self.verdict!r}: no unknown force; refine() takes what was found"
                )
            raise ModelError(
                "no table of a force over position and velocity, or of a channel, reduces the error"
            )
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
        return self.ranking[0] if self.ranking else None

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Missing effects of the best candidate, the most certain first.

        They are empty where none is named.
        """
        named = self.best is not None and self.verdict in ("effect", "ambiguous")
        return self.best.effects if named and self.best is not None else ()

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

        if self.floated is not None:
            return self.floated
        if self.best is None:
            return self.base
        options = ("tolerance", "offset", "noise", "horizon")
        settings = {k: self.settings[k] for k in options if k in self.settings}
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
        from .experiment_design.suggest import suggest

        if self.base.of_responses:
            raise ModelError(
                "experiments are planned for records in time; of frequency responses more outputs, a wider "
                "band or other amplitudes tell candidates apart"
            )
        return suggest(
            self,
            probability=probability,
            repeat=repeat,
            amplitudes=amplitudes,
            lengths=lengths,
            bands=bands,
            sensors=sensors,
            costs=costs,
            largest_input=largest_input,
        )

    def ordered_records(self) -> list[Measurement]:
        """The records, channels in the order of the model.

        Returns
        -------
        list of Measurement
        """
        from ..models.operating_point import ordered_record

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
