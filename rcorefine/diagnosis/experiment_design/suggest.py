"""Cheapest experiment that distinguishes the remaining candidates.

The present record cannot distinguish them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ...arguments import as_flag, as_list, as_mapping, as_number, as_share, as_texts, as_vector, shown
from ...data.measurement import Measurement
from ...engine.engine import Engine
from ...engine.leading import leading_gain
from ...exceptions import DivergenceError
from ...inference.fitted import FittedModel, fitted_from
from ...inference.levels import levels
from ...inference.refinement import Refinement
from ...inference.sensitivities import candidate_columns
from ...inference.starts import Motion
from ...inference.whitening import Whitener
from ...inference.windows import windows
from ...models.operating_point import refuse_point
from ...systems.linear import Array
from ..hypothesis import Hypothesis
from ..refits import Fitter
from ..residual_tests import TestedResidual
from ..screening import Metric, Numbers, Screen
from .planning import Proposal, default_bands, proposals
from .result import ExperimentAdvice, ExperimentOption
from .sensors import sensor_rows
from .separation import Contender, Plan, Separation, separation

if TYPE_CHECKING:
    from ..result import Diagnosis

__all__ = ["suggest"]

_COSTS = {"repeat": 1.0, "amplitude": 1.5, "band": 2.0, "longer": 1.0, "sensor": 6.0}
_MOST = 8  # contenders that are simulated
_NEAR = 0.2  # p-value, corrected for the candidates, below which an adequate model has something near
_FEW = 3  # such candidates at most
_BEYOND = 1.25  # motion over the largest seen that calls for a warning
_NESTED = 1.0  # squared distance below which no record of the kind tells a pair apart


def suggest(
    found: Diagnosis,
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
    """Implement `Diagnosis.suggest_experiment`, which is documented there."""
    prices = _checked(amplitudes, lengths, bands, costs)
    as_flag(repeat, "repeat")
    probability = as_share(probability, "probability")
    if sensors is not None:
        sensors = as_texts(sensors, "sensors")
        sensor_rows(found.base.physical_model, sensors)
    refuse_point(found.base.physical_model, "suggest_experiment")
    records = found.ordered_records()
    if largest_input is not None:
        largest_input = as_vector(largest_input, "largest_input", above=0.0, error=ct.ControlArgument)
        if largest_input.size not in (1, records[0].n_inputs):
            raise ct.ControlArgument(
                f"largest_input must be positive, one number or one for each of the {records[0].n_inputs} "
                f"inputs, not {largest_input.size} numbers"
            )
    contenders, fitted, why = _contenders(found, records)
    if len(contenders) < 2:
        return ExperimentAdvice(None, (), tuple(c.label for c in contenders), probability, why)
    model = found.base.physical_model
    asked = default_bands(model, records[0]) if bands is None else [(float(a), float(b)) for a, b in bands]
    listed = proposals(
        model, records[0], repeat=repeat, amplitudes=amplitudes, lengths=lengths, bands=asked,
        sensors=sensors, costs=prices,
    )  # fmt: skip
    judge = _Judge(contenders, fitted, records, found.force_ratio, largest_input)
    options = [judge.option(proposal) for proposal in listed]
    return _advice(options, contenders, judge, probability, why)


def _checked(
    amplitudes: Any, lengths: Any, bands: Any, costs: Mapping[str, float] | None
) -> dict[str, float]:
    for name, values in (("amplitudes", amplitudes), ("lengths", lengths)):
        if len(as_list(values, name, "positive factors")):
            as_vector(values, name, above=0.0, error=ct.ControlArgument)
    for pair in () if bands is None else as_list(bands, "bands", "pairs (low, high) in rad/s"):
        low, high = as_vector(pair, "a band (low, high) in rad/s", 2, least=0.0, error=ct.ControlArgument)
        if not low < high:
            raise ct.ControlArgument(f"bands must be pairs in rad/s, the lower first, not {shown(pair)}")
    prices = dict(_COSTS)
    for name, value in as_mapping(costs, "costs", "numbers").items():
        if name not in prices:
            raise ct.ControlArgument(f"costs names {name!r}; there are {', '.join(prices)}")
        prices[name] = as_number(value, f"costs[{name!r}]", least=0.0)
    return prices


def _contenders(found: Diagnosis, records: Sequence[Measurement]) -> tuple[list[Contender], FittedModel, str]:
    """Return the remaining explanations and the fitted best model.

    A message gives the reason if there is nothing to separate.
    """
    settings = found.settings
    options = {"tolerance": settings["tolerance"], "noise": settings["noise"]}
    segments, _ = windows(found.base.physical_model, list(records), settings["horizon"])
    if found.verdict == "adequate":
        return _near(found, fitted_from(found.base, segments, **options))
    if found.floated is not None:
        why = "Nothing to separate: no law is needed; refine() has the numbers of the model as they are."
        return [], fitted_from(found.floated, segments, **options), why
    if found.best is None and found.verdict == "ambiguous":
        why = "The record shows no motion from which candidates could be simulated: excite it, then diagnose."
        return [], fitted_from(found.base, segments, **options), why
    if found.best is None or found.verdict == "unexplained":
        why = (
            "Nothing to separate: none of the candidates explains the record. A second record at another "
            "amplitude tells a law outside the library from a fault of the record (give both to diagnose); "
            "other candidates may explain it."
        )
        return [], fitted_from(found.base, segments, **options), why
    fitted = fitted_from(found.best.refinement, segments, **options)
    rows = [r for r in found.ranking if r.alike][:_MOST]
    total = sum(row.probability for row in rows) or 1.0
    contenders = [
        Contender(row.effect, row.refinement, row.probability / total, 2 * row.log_likelihood_gain)
        for row in rows
    ]
    none = ""
    if found.none_of_these > levels().no_law:
        none = (
            f" None of these laws has probability {found.none_of_these:.2f}; no option tells that, but "
            "confirm does with a record at another amplitude."
        )
    if len(contenders) == 1:
        sizes = [float(np.sqrt(np.mean(record.inputs**2))) for record in records]
        why = f"Nothing to separate: {contenders[0].label} stands alone among the laws."
        if max(sizes) < 1.3 * min(sizes):
            why += (
                " A second record at another amplitude, given to diagnose together with this one, would "
                "confirm the law."
            )
        return contenders, fitted, why + none
    left = len(found.ambiguous) - len(rows)
    return contenders, fitted, (f"{left} less probable candidates were left out. " if left > 0 else "") + none


def _near(found: Diagnosis, fitted: FittedModel) -> tuple[list[Contender], FittedModel, str]:
    """Return the nearly significant effects of an adequate model.

    The alternative to them is that nothing is missing.
    """
    nothing = "Nothing to separate: no test fires, and no candidate comes near."
    effects = [d.effect for d in found.detectable]
    alone = [Contender(None, found.base, 0.0, 0.0)]
    if not effects:
        return alone, fitted, nothing
    motion = Motion(fitted.structure, fitted.theta, fitted.problem.records[0])
    scored = candidate_columns(fitted, effects, motion, (0.0, found.force_ratio))
    tests = TestedResidual(fitted, found.force_ratio).each(scored)
    order = np.argsort([t.p_value for t in tests], kind="stable")
    near = [i for i in order if tests[i].p_value * len(tests) < _NEAR]
    fitter = Fitter(fitted, motion)
    metric = Metric(fitted.problem.whitener(fitted.residuals()), None, 0.0)
    trials = []
    for candidate in (scored[i] for i in near[:_FEW]):
        screen = Screen(fitted, [candidate], Numbers([], np.zeros(0)), metric, motion)
        starts = [screen.start([group], False, fitted) for group in screen.groups]
        trials.append(fitter.fit(Hypothesis((candidate.effect,)), fitted, starts, shared=True))
    likely = sorted((t for t in trials if t is not None), key=lambda trial: -trial.total)
    if not likely:
        return alone, fitted, nothing
    base = fitter.empty(Hypothesis(), fitted).total
    weights = np.exp([trial.total - likely[0].total for trial in likely])
    weights /= weights.sum()
    contenders = [
        Contender(trial.effects[0], trial.model.refinement, float(weight), 2 * (trial.total - base))
        for trial, weight in zip(likely, weights, strict=True)
    ]
    return [*contenders, *alone], fitted, ""


class _Judge:
    """Simulates and judges proposals for one diagnosis."""

    def __init__(
        self,
        contenders: Sequence[Contender],
        fitted: FittedModel,
        records: Sequence[Measurement],
        ratio: float,
        largest_input: Array | None,
    ) -> None:
        self.contenders, self.fitted, self.records, self.ratio = contenders, fitted, records, ratio
        self.limit = largest_input
        self.levels = 1.0 / fitted.problem.weights
        self.whitener = Whitener.fit(fitted.residuals(ratio))
        self.before = sum(record.outputs.size for record in records)
        self.best: Refinement = contenders[0].refinement
        self.seen = self._largest(records)

    def option(self, proposal: Proposal) -> ExperimentOption:
        """A proposal with its probability and its reach."""
        record = proposal.record
        try:
            reach, where = self._reach(record)
        except DivergenceError:
            reach, where = np.inf, ""
        result = Separation(0.0, 0.0, np.zeros((1, 1)), "the model runs away there")
        if np.isfinite(reach):
            result = self._judged(proposal)
        over = self.limit is not None and bool((np.abs(record.inputs).max(axis=1) > self.limit).any())
        failed = "beyond largest_input" if over else result.failed
        truths = [i for i, c in enumerate(self.contenders) if c.weight > 0]
        pairs = [result.distances[i, j] for i in truths for j in range(len(self.contenders)) if i != j]
        return ExperimentOption(
            kind=proposal.kind,
            name=proposal.name,
            cost=proposal.cost,
            probability=0.0 if failed else result.probability,
            wrong=0.0 if failed else result.wrong,
            distance=0.0 if failed else float(min(pairs)),
            reach=float(reach), reach_where=where, inputs=record.inputs, failed=failed,
        )  # fmt: skip

    def _judged(self, proposal: Proposal) -> Separation:
        noise, whitener = self.levels, self.whitener
        if proposal.sensor is not None:
            noise = np.append(noise, self._sensor_noise(proposal))
            # a sensor of the same sort: noise of the colour of the first one
            whitener = Whitener(
                (*whitener.filters, whitener.filters[0]), np.append(whitener.scales, whitener.scales[0])
            )
        joined = proposal.sensor is None
        plan = Plan(proposal.record, noise, whitener, proposal.sensor, joined, self.before)
        return separation(self.contenders, plan, self.ratio)

    def _sensor_noise(self, proposal: Proposal) -> float:
        """Relative to its signal as the present sensors are to theirs."""
        assert proposal.sensor is not None
        spread = np.concatenate([r.outputs for r in self.records], axis=1).std(axis=1)
        relative = float(np.median(self.levels / np.where(spread > 0, spread, 1.0)))
        row = proposal.sensor[1]
        signal = row @ self._states(self.records[0])[: row.size]
        return relative * (float(np.std(signal)) or 1.0)

    def _states(self, record: Measurement) -> Array:
        structure, theta, steps = self.best.simulation_structure()
        engine = Engine(structure, record, substeps=steps, lead=leading_gain(structure, record))
        return engine.run(theta, self.best.initial_states[0], sensitivity=False, histories=True).states

    def _largest(self, records: Sequence[Measurement]) -> dict[str, float]:
        """Largest motion at every port and of every input."""
        found: dict[str, float] = {}
        for record in records:
            x = self._states(record)
            for port in self.best.physical_model.ports:
                row, through = port.position, port.position_input
                if not port.has_position:
                    row, through = port.velocity, port.velocity_input
                motion = row @ x[: row.size] + through @ record.inputs
                found[port.name] = max(found.get(port.name, 0.0), float(np.abs(motion).max()))
            for label, signal in zip(record.input_labels, record.inputs, strict=True):
                key = f"input {label}"
                found[key] = max(found.get(key, 0.0), float(np.abs(signal).max()))
        return found

    def _reach(self, record: Measurement) -> tuple[float, str]:
        asked = self._largest([record])
        shares = {key: asked[key] / value for key, value in self.seen.items() if value > 0}
        where = max(shares, key=lambda key: shares[key], default="")
        return shares.get(where, 1.0), where


def _advice(
    options: Sequence[ExperimentOption],
    contenders: Sequence[Contender],
    judge: _Judge,
    probability: float,
    why: str,
) -> ExperimentAdvice:
    possible = [option for option in options if not option.failed]
    names = tuple(c.label for c in contenders)
    notes = [why.strip()] if why else []
    notes += [f"Not possible: {o.name} ({o.failed})." for o in options if o.failed]
    if not possible:
        message = (
            "None of these experiments is possible; allow others (amplitudes=, lengths=, bands=, sensors=)."
        )
        return ExperimentAdvice(None, tuple(options), names, probability, message, tuple(notes))
    best = max(possible, key=lambda o: o.probability)
    chosen = _cheapest(possible, probability) or best
    message = _who(contenders, chosen, None if chosen.probability >= probability else probability)
    if chosen.reach > _BEYOND:
        notes.append(
            f"That takes {chosen.reach_where} to {chosen.reach:.2g} times the largest value in this record, "
            "which cannot vouch for what comes there: stops, saturation, the range of the sensors, laws that "
            "only show at such amplitudes."
        )
    if best.distance < _NESTED and best.probability < probability:
        notes.append(
            "Two of the candidates hardly differ under any of these experiments: one may contain the "
            "other as a special case, or the difference is too small for this noise."
        )
    if chosen.kind == "sensor":
        notes.append("The new record alone is counted there: the model then has one output more.")
    return ExperimentAdvice(chosen, tuple(options), names, probability, message, tuple(notes))


def _cheapest(possible: Sequence[ExperimentOption], probability: float) -> ExperimentOption | None:
    """Return the cheapest option with the required probability, or None.

    Of options with equal cost, the most probable is chosen.
    """
    enough = [option for option in possible if option.probability >= probability]
    return min(enough, key=lambda o: (o.cost, -o.probability), default=None)


def _who(contenders: Sequence[Contender], option: ExperimentOption, missed: float | None) -> str:
    """Describe an option and the probability that it decides.

    `missed` is the required probability if no option reaches it, otherwise None.
    """
    names = [c.label for c in contenders]
    who = (
        f"{names[0]} and {names[1]} then separate"
        if len(names) == 2
        else f"the {len(names)} candidates then separate"
    )
    if any(c.effect is None for c in contenders):
        who = f"{names[0]} would then stand out, if it is there,"
    what = f"{option.name[0].upper()}{option.name[1:]}"
    if missed is not None:
        what = f"No option reaches {missed:g}. Best: {option.name}"
    return f"{what}: {who} with probability {option.probability:.2f}."
