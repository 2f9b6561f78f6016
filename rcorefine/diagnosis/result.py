"""What a diagnosis found, in figures and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..inference.refinement import EstimatedParameter, Refinement
from ..inference.whitening import FTest
from ..results import Look, Reported, picture, show
from .absorbed import numbers_that_moved, what_was_absorbed

if TYPE_CHECKING:
    from .experiment_design.result import ExperimentAdvice

__all__ = ["Detectable", "Diagnosis", "RankedEffect"]


@dataclass(frozen=True, slots=True, eq=False)
class RankedEffect:
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
        Among the candidates, given that exactly one of them is missing.
    log_likelihood_gain : float
        Over the model as it is, less half the log of the number of samples for each
        coefficient beyond the first.
    refinement : Refinement
        Model with this effect, refitted.
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


@dataclass(frozen=True, slots=True)
class Detectable:
    """The smallest coefficient of an effect that the record would have shown (95 % power)."""

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
        "adequate" (nothing is missing that this record could show), "parameters" (no law is
        missing, the numbers of the model are off), "effect" (one of the
        candidates is), "ambiguous" (several explain it alike), "unexplained" (something
        is missing that none of the candidates explains).
    ranking : tuple of RankedEffect
        Candidates that were refitted, the most probable first.
    ambiguous : tuple of Effect
        Effects that this record cannot tell from the best one, the best included.
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
        """Numbers of the model with their errors, where the verdict is "parameters"; else empty."""
        return () if self.floated is None else tuple(r for r in self.floated.parameters if r.role == "linear")

    @property
    def best(self) -> RankedEffect | None:
        """First row of the ranking, None where nothing was needed or tried."""
        return self.ranking[0] if self.ranking else None

    def refine(self) -> Refinement:
        """The model with the best effect, fitted to convergence from where the ranking left it.

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
        """The cheapest experiment that would tell apart what this record cannot.

        Every rival is simulated under every option and every other rival is refitted to
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
        control.ControlArgument
            If an option is out of its range, or a place does not exist.

        Notes
        -----
        With D the squared distance between the outputs of two rivals after one is
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
        from ..data.channels import match_channels, record_for

        linear = self.base.physical_model.linear
        return [record_for(r, match_channels(linear, r)) for r in self.records]

    # ------------------------------------------------------------------ in words
    def sentences(self) -> list[str]:
        """What was found, one sentence each.

        Returns
        -------
        list of str
        """
        lines = [_VERDICTS[self.verdict].format(best=self._best_text(), alike=self._alike_text())]
        worst = min(self.tests, key=lambda t: t.p_value) if self.tests else None
        if self.verdict == "adequate":
            lines[0] = f"{lines[0]} {what_was_absorbed(self.base)}".rstrip()
            lines.append(
                f"No test fires at the level {self.significance:g}"
                + (f" (smallest p-value {worst.p_value:.2g}, {worst.name})." if worst else ".")
            )
            if self.detectable:
                shown = ", ".join(
                    f"{d.effect.label} {d.smallest:.3g} {d.unit}".strip() for d in self.detectable[:4]
                )
                lines.append(f"It would have shown, with 95 % probability: {shown}.")
        elif worst is not None:  # without motion nothing could be tested
            lines.append(f"The model as it is fails: {worst.name}, p = {worst.p_value:.2g}.")
            if self.verdict == "unexplained" and self.winner_tests:
                left = min(self.winner_tests, key=lambda t: t.p_value)
                lines.append(
                    f"With the best candidate the residual still fails: {left.name}, p = {left.p_value:.2g}."
                )
            if self.verdict == "parameters":
                lines.append(numbers_that_moved(self.parameters))
            if self.best is not None and self.best.effect.spec.of_record:
                (share,) = self.best.coefficients.values()
                lines.append(
                    f"{self.best.effect.explanation} Here that are {100 * share:.3g} %: correct the record, "
                    "not the model."
                )
            if self.best is not None:
                lines.append(
                    "p is the chance of such a score with nothing missing; probability compares the "
                    "candidates with each other; std is one standard deviation of the coefficient."
                )
        if self.force_ratio:
            lines.append(
                f"The residual speaks of an unmeasured force of about {100 * self.force_ratio:.2g} % of the "
                "measured one, which is allowed for."
            )
        if self.verdict == "ambiguous":
            lines.append("suggest_experiment() names the record that would tell them apart.")
        return [*lines, *self.notes]

    def _best_text(self) -> str:
        if self.best is None:
            return "nothing"
        row = self.best
        values = ", ".join(f"{value:.4g} +/- {row.std[name]:.2g}" for name, value in row.coefficients.items())
        return (
            f"{row.effect.label} ({values}): fit {row.fit_before:.4g} -> {row.fit_after:.4g} %, "
            f"probability {row.probability:.2f}"
        )

    def _alike_text(self) -> str:
        return ", ".join(effect.label for effect in self.ambiguous)

    @picture
    def plot(self, **options: Unpack[Look]) -> ct.ControlPlot:
        """Ranking, hidden force against motion, residual before and after.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)


_VERDICTS = {
    "adequate": "Nothing is missing that this record could show.",
    "parameters": "No law is missing: the numbers of the model are off.",
    "effect": "What is missing: {best}.",
    "ambiguous": "This record cannot tell apart: {alike}. Most probable: {best}.",
    "unexplained": "Something is missing that no candidate explains. Closest: {best}.",
}
