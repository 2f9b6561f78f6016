"""Cheapest experiment that distinguishes the remaining candidates.

The present record cannot distinguish them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_flag, as_list, as_mapping, as_number, as_share, as_texts, as_vector, shown
from ..data.measurement import Measurement
from ..data.signals import measured, spreads
from ..engine.engine import Engine
from ..engine.observer import leading_gain
from ..exceptions import DivergenceError
from ..inference.assembly import windows
from ..inference.fitted import FittedModel, fitted_from
from ..inference.levels import levels
from ..inference.refinement import Refinement
from ..inference.sensitivities import candidate_columns
from ..inference.starts import Motion
from ..inference.whitening import Whitener
from ..models.operating_point import refuse_point
from ..models.physical_model import PhysicalModel
from ..results import Options, Result, Row, frequency_text, picture, show
from ..systems.linear import Array
from .hypothesis import Hypothesis
from .refits import Fitter
from .residual_tests import TestedResidual
from .screening import Metric, Screen
from .separation import Contender, Plan, Separation, sensor_rows, separation

if TYPE_CHECKING:
    from .result import Diagnosis


_COSTS = {"repeat": 1.0, "amplitude": 1.5, "band": 2.0, "longer": 1.0, "sensor": 6.0}
_MOST = 8  # contenders that are simulated
_NEAR = 0.2  # p-value, corrected for the candidates, below which an adequate model has something near
_FEW = 3  # such candidates at most
_BEYOND = 1.25  # motion over the largest seen that calls for a warning
_PARAMETERS = "Nothing to separate: no additional effect is needed; refine() re-estimates the parameters."
_STILL = "The record shows no motion from which candidates could be simulated: excite it, then diagnose."
_UNEXPLAINED = (
    "Nothing to separate: none of the candidates explains the record. A second record at another "
    "amplitude tells a law outside the library from a fault of the record (give both to diagnose); "
    "other candidates may explain it."
)
_NESTED = 1.0  # squared distance below which no record of the kind tells a pair apart


def suggest(
    found: Diagnosis,
    probability: float,
    costs: Mapping[str, float] | None,
    largest_input: ArrayLike | None,
    **asked: Any,
) -> ExperimentAdvice:
    """Implement `Diagnosis.suggest_experiment`, which is documented there."""
    probability = as_share(probability, "probability")
    model = found.base.physical_model
    refuse_point(model, "suggest_experiment")
    records = found.ordered_records()
    if largest_input is not None:
        largest_input = as_vector(largest_input, "largest_input", above=0.0, error=ct.ControlArgument)
        if largest_input.size not in (1, records[0].n_inputs):
            raise ct.ControlArgument(
                f"largest_input must be positive, one number or one for each of the {records[0].n_inputs} "
                f"inputs, not {largest_input.size} numbers"
            )
    prices = dict(_COSTS)
    for name, value in as_mapping(costs, "costs", "numbers").items():
        if name not in prices:
            raise ct.ControlArgument(f"costs names {name!r}; there are {', '.join(prices)}")
        prices[name] = as_number(value, f"costs[{name!r}]", least=0.0)
    as_flag(asked["repeat"], "repeat")
    # candidate experiments, and the explanations that they must distinguish
    listed = _proposals(model, records[0], prices, **asked)
    named = found.best if found.effects else None
    best = found.floated or (found.base if named is None else named.refinement)
    # free runs in the windows of the diagnosis
    segments, _ = windows(model, records, found.settings["horizon"])
    tolerance, noise = found.settings["tolerance"], found.settings["noise"]
    fitted = fitted_from(best, segments, tolerance=tolerance, noise=noise)
    contenders, why = _contenders(found, fitted, records)
    if len(contenders) < 2:
        return ExperimentAdvice(None, (), tuple(c.label for c in contenders), probability, why)
    # simulate each experiment under each explanation
    judge = _Judge(contenders, fitted, records, found.force_ratio, largest_input)
    return _advice([judge.option(proposal) for proposal in listed], judge, probability, why)


def _contenders(
    found: Diagnosis, fitted: FittedModel, records: Sequence[Measurement]
) -> tuple[list[Contender], str]:
    """Return the remaining explanations, and a message about them."""
    if found.verdict == "adequate":
        return _near(found, fitted)
    if found.floated is not None:
        return [], _PARAMETERS
    if not found.effects:
        return [], _UNEXPLAINED if found.verdict == "unexplained" else _STILL
    # candidates that the data cannot distinguish, with normalized probabilities
    alike = [row for row in found.ranking if row.alike]
    rows, left = alike[:_MOST], len(alike) - _MOST
    total = sum(row.probability for row in rows) or 1.0
    contenders = [
        Contender(row.effect, row.refinement, row.probability / total, 2 * row.log_likelihood_gain)
        for row in rows
    ]
    why = f"{left} less probable candidates were left out. " if left > 0 else ""
    if len(contenders) == 1:
        sizes = [float(np.sqrt(np.mean(record.inputs**2))) for record in records]
        why = f"Nothing to separate: {contenders[0].label} stands alone among the laws."
        if max(sizes) < 1.3 * min(sizes):
            why += (
                " A second record at another amplitude, given to diagnose together with this one, would "
                "confirm the law."
            )
    if found.none_of_these > levels().no_law:
        why += (
            f" None of these laws has probability {found.none_of_these:.2f}; no option tells that, but "
            "confirm does with a record at another amplitude."
        )
    return contenders, why


def _near(found: Diagnosis, fitted: FittedModel) -> tuple[list[Contender], str]:
    """Return the nearly significant effects of an adequate model.

    The alternative to them is that nothing is missing.
    """
    nothing = "Nothing to separate: no test fires, and no candidate comes near."
    effects = [d.effect for d in found.detectable]
    alone = [Contender(None, found.base, 0.0, 0.0)]
    if not effects:
        return alone, nothing
    # nearly significant candidates of an adequate model: score tests, then full fits
    motion = Motion(fitted.structure, fitted.theta, fitted.problem.records[0])
    scored = candidate_columns(fitted, effects, motion, (0.0, found.force_ratio))
    tests = TestedResidual(fitted, found.force_ratio).each(scored)
    order = np.argsort([t.p_value for t in tests], kind="stable")
    # close to significance: corrected p-value below 0.2, three candidates at most
    near = [i for i in order if tests[i].p_value * len(tests) < _NEAR]
    fitter = Fitter(fitted, motion)
    metric = Metric(fitted.problem.whitener(fitted.residuals()), None, 0.0)
    trials = []
    for candidate in (scored[i] for i in near[:_FEW]):
        screen = Screen(fitted, [candidate], {}, metric, motion)
        starts = [screen.start([group], False, fitted) for group in screen.groups]
        trials.append(fitter.fit(Hypothesis((candidate.effect,)), fitted, starts, shared=True))
    likely = sorted((t for t in trials if t is not None), key=lambda trial: -trial.total)
    if not likely:
        return alone, nothing
    # probabilities from their evidence, against "nothing is missing"
    base = fitter.empty(Hypothesis(), fitted).total
    weights = np.exp([trial.total - likely[0].total for trial in likely])
    weights /= weights.sum()
    contenders = [
        Contender(trial.effects[0], trial.model.refinement, float(weight), 2 * (trial.total - base))
        for trial, weight in zip(likely, weights, strict=True)
    ]
    return [*contenders, *alone], ""


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
        self.contenders, self.records, self.ratio = contenders, records, ratio
        self.limit = largest_input
        # noise levels and color of the record at hand, taken over to the new one
        self.levels = 1.0 / fitted.problem.weights
        self.whitener = fitted.problem.whitener(fitted.residuals(ratio))
        self.before = measured(record.outputs for record in records)
        self.best: Refinement = contenders[0].refinement
        self.seen = self._largest(records)

    def option(self, proposal: Proposal) -> ExperimentOption:
        """Return a proposal with its probability and its reach."""
        record, result = proposal.record, Separation(0.0, 0.0, np.zeros((1, 1)), "the model runs away there")
        reach, where = np.inf, ""
        try:
            # largest motion against the largest in the record
            largest = self._largest([record])
            shares = {key: largest[key] / value for key, value in self.seen.items() if value > 0}
            where = max(shares, key=lambda key: shares[key], default="")
            reach = shares.get(where, 1.0)
        except DivergenceError:
            pass
        if np.isfinite(reach):
            noise, whitener, new = self.levels, self.whitener, proposal.sensor
            # a new sensor gets the median noise-to-signal ratio of the others
            if new is not None:  # of the same sort: noise of the color of the first one
                noise = np.append(noise, self._sensor_noise(new[1]))
                scales = np.append(whitener.scales, whitener.scales[0])
                whitener = Whitener((*whitener.filters, whitener.filters[0]), scales)
            plan = Plan(record, noise, whitener, new, new is None, self.before)
            # expected log-likelihood distances between the explanations
            result = separation(self.contenders, plan, self.ratio)
        over = self.limit is not None and bool((np.abs(record.inputs).max(axis=1) > self.limit).any())
        failed = "beyond largest_input" if over else result.failed
        truths = [i for i, c in enumerate(self.contenders) if c.weight > 0]
        # the closest pair decides
        pairs = [result.distances[i, j] for i in truths for j in range(len(self.contenders)) if i != j]
        figures = (0.0, 0.0, 0.0) if failed else (result.probability, result.wrong, float(min(pairs)))
        about = (proposal.kind, proposal.name, proposal.cost)
        return ExperimentOption(*about, *figures, float(reach), where, record.inputs, failed)

    def _sensor_noise(self, row: Array) -> float:
        """Return the noise of a new sensor, relative to its signal as the others."""
        spread = spreads(np.hstack([r.outputs for r in self.records]))
        # median noise-to-signal ratio of the present outputs
        relative = float(np.median(self.levels / spread))
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
            # displacement at each port, or its velocity where it has none
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


def _advice(
    options: Sequence[ExperimentOption], judge: _Judge, probability: float, why: str
) -> ExperimentAdvice:
    """Return the cheapest sufficient option, else the most probable one."""
    possible = [option for option in options if not option.failed]
    names = tuple(c.label for c in judge.contenders)
    notes = [why.strip()] if why else []
    notes += [f"Not possible: {o.name} ({o.failed})." for o in options if o.failed]
    if not possible:
        message = (
            "None of these experiments is possible; allow others (amplitudes=, lengths=, bands=, sensors=)."
        )
        return ExperimentAdvice(None, tuple(options), names, probability, message, tuple(notes))
    # cheapest option that is likely to decide, otherwise the most probable one
    best = max(possible, key=lambda o: o.probability)
    enough = [option for option in possible if option.probability >= probability]
    chosen = min(enough, key=lambda o: (o.cost, -o.probability), default=best)
    message = _message(judge.contenders, chosen, probability)
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


def _message(contenders: Sequence[Contender], chosen: ExperimentOption, probability: float) -> str:
    """Describe the chosen option, and the probability that it decides."""
    names = [c.label for c in contenders]
    who = " and ".join(names) if len(names) == 2 else f"the {len(names)} candidates"
    who = f"{who} then separate"
    if any(c.effect is None for c in contenders):
        who = f"{names[0]} would then stand out, if it is there,"
    what = chosen.name[0].upper() + chosen.name[1:]
    if chosen.probability < probability:
        what = f"No option reaches {probability:g}. Best: {chosen.name}"
    return f"{what}: {who} with probability {chosen.probability:.2f}."


_MODES = 2  # bands about the lowest modes
_ABOUT = 0.2  # half width of such a band over its frequency
_LINES = 8  # frequency lines that a band must hold
_WORDS = {2.0: "twice", 3.0: "three times", 4.0: "four times", 5.0: "five times"}


class Proposal(NamedTuple):
    """An experiment: its inputs, what it asks for, its cost.

    Attributes
    ----------
    kind : str
        "repeat", "amplitude", "band", "longer" or "sensor".
    name : str
        In words.
    record : Measurement
        Inputs; the outputs are zero.
    cost : float
        In lengths of the present record.
    sensor : tuple of (str, ndarray), or None
        Label and row of the new output.
    """

    kind: str
    name: str
    record: Measurement
    cost: float
    sensor: tuple[str, Array] | None = None


def _proposals(
    model: PhysicalModel,
    record: Measurement,
    costs: Mapping[str, float],
    repeat: bool,
    amplitudes: Any,
    lengths: Any,
    bands: Any,
    sensors: Any,
) -> list[Proposal]:
    """Return all experiments to be judged, the cheapest first.

    The arguments are those of `Diagnosis.suggest_experiment`, and are checked here.
    """
    # repeat, other amplitude, other band, longer record, further sensor
    w, found = record.inputs, []
    factors = {}
    for name, values in (("amplitudes", amplitudes), ("lengths", lengths)):
        factors[name] = as_list(values, name, "positive factors")
        if factors[name]:
            as_vector(values, name, above=0.0, error=ct.ControlArgument)
    if repeat:
        found.append(Proposal("repeat", "repeat the record", _blank(record, w), costs["repeat"]))
    for factor in factors["amplitudes"]:
        said = (
            f"{_WORDS.get(factor, f'{factor:g} times')} as hard"
            if factor > 1
            else f"at {factor:g} of the amplitude"
        )
        cost = costs["amplitude"] + 0.1 * abs(np.log2(factor))  # the nearer to the record, the safer
        found.append(Proposal("amplitude", f"drive {said}", _blank(record, factor * w), cost))
    if bands is None:
        bands = _default_bands(model, record)
    for pair in as_list(bands, "bands", "pairs (low, high) in rad/s"):
        low, high = as_vector(pair, "a band (low, high) in rad/s", 2, least=0.0, error=ct.ControlArgument)
        if not low < high:
            raise ct.ControlArgument(f"bands must be pairs in rad/s, the lower first, not {shown(pair)}")
        name = f"excite {frequency_text(low)} to {frequency_text(high)}, same rms"
        shaped = in_band(w, record.dt, float(low), float(high))
        found.append(Proposal("band", name, _blank(record, shaped), costs["band"]))
    for factor in factors["lengths"]:
        name = f"record {_WORDS.get(factor, f'{factor:g} times')} as long"
        n = round(factor * w.shape[1])  # the same kind of input, repeated from its beginning
        longer = _blank(record, np.tile(w, -(-n // w.shape[1]))[:, :n])
        found.append(Proposal("longer", name, longer, costs["longer"] * factor))
    named = None if sensors is None else as_texts(sensors, "sensors")
    for place, label, row in sensor_rows(model, named):
        name = f"repeat with a sensor at {place}"
        found.append(Proposal("sensor", name, _blank(record, w), costs["sensor"], (label, row)))
    return sorted(found, key=lambda p: p.cost)


def _blank(like: Measurement, inputs: Array) -> Measurement:
    return Measurement(
        inputs, np.zeros((like.n_outputs, inputs.shape[1])), dt=like.dt, hold=like.hold,
        input_labels=like.input_labels, output_labels=like.output_labels,
    )  # fmt: skip


def in_band(w: Array, dt: float, low: float, high: float) -> Array:
    """Return a random-phase multisine between two frequencies (rad/s).

    Mean and rms of the input are kept.
    """
    n = w.shape[1]
    # random phases at the lines of the band
    omega = 2 * np.pi * np.fft.rfftfreq(n, dt)
    lines = np.flatnonzero((omega >= low) & (omega <= high) & (omega > 0))
    rng = np.random.default_rng(0)
    spectrum = np.zeros((w.shape[0], omega.size), dtype=complex)
    spectrum[:, lines] = np.exp(2j * np.pi * rng.random((w.shape[0], lines.size)))
    signal = np.fft.irfft(spectrum, n, axis=1)
    # scale to the rms of the record
    size = signal.std(axis=1, keepdims=True)
    size[size == 0] = 1.0
    return np.asarray(w.mean(axis=1, keepdims=True) + signal * (w.std(axis=1, keepdims=True) / size))


def _default_bands(model: PhysicalModel, record: Measurement) -> list[tuple[float, float]]:
    """Return frequency bands (rad/s) for the modes of the model.

    They are the lower and the upper half of the band of the model, and bands around its lowest modes.
    """
    # from 0.3 times the slowest pole to twice the fastest, within half the Nyquist frequency
    poles = np.linalg.eigvals(model.linear.A)
    nyquist, line = np.pi / record.dt, 2 * np.pi / record.duration
    modes = np.unique(np.round(np.abs(poles[np.imag(poles) > 0.3 * np.abs(poles)]), 12))
    speeds = np.abs(poles[np.abs(poles) > line])
    if speeds.size == 0:
        return []
    low = max(0.3 * float(speeds.min()), line)
    high = min(2.0 * float(speeds.max()), 0.5 * nyquist)
    middle = float(np.sqrt(low * high))
    found = [(low, middle), (middle, high)]
    found += [((1 - _ABOUT) * m, (1 + _ABOUT) * m) for m in modes[:_MODES] if modes.size > 1]
    return [(a, b) for a, b in found if (b - a) / line >= _LINES and b <= nyquist]


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentOption(Row):
    """One experiment that could be made.

    Attributes
    ----------
    kind : str
        "repeat", "amplitude", "band", "longer" or "sensor".
    name : str
        What to do, in words.
    cost : float
        In lengths of the present record.
    probability : float
        That the true effect then stands alone.
    wrong : float
        That a wrong one then leads by as much.
    distance : float
        Squared distance, over the noise, between the outputs of the closest two candidates
        after one was refitted to the other.
    reach : float
        Largest motion at any port, or input, over the largest in the present record.
    reach_where : str
        The port or input where that is.
    inputs : ndarray, shape (n_w, N)
        Inputs to apply, sampled and held like those of the present record. The
        probability is that of these: another random input of the same kind can move a
        lightly damped model more, or less.
    failed : str
        Why it cannot be made, empty where it can.
    """

    kind: str
    name: str
    cost: float
    probability: float
    wrong: float
    distance: float
    reach: float
    reach_where: str
    inputs: Array
    failed: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentAdvice(Result):
    """Recommended next experiment and its alternatives.

    Attributes
    ----------
    chosen : ExperimentOption or None
        The cheapest that reaches the probability, else the most probable; None where
        there is nothing to separate.
    options : tuple of ExperimentOption
        All of them, the cheapest first.
    rivals : tuple of str
        Candidates that the record cannot distinguish.
    probability : float
        Probability that was asked for.
    message : str
        The advice in one sentence.
    notes : tuple of str
        Warnings: what the present record cannot vouch for.
    """

    chosen: ExperimentOption | None
    options: tuple[ExperimentOption, ...]
    rivals: tuple[str, ...]
    probability: float
    message: str
    notes: tuple[str, ...] = ()

    def sentences(self) -> list[str]:
        """The advice, and what the figures mean.

        Returns
        -------
        list of str
        """
        lines = [self.message]
        if self.options:
            lines.append(
                "probability: that the true one then stands alone (twice the log-likelihood 9.2 ahead of "
                "any other candidate); distance: squared, over the noise, between the closest two; cost: in "
                "lengths of this record; reach: largest motion over the largest in this record."
            )
        return [*lines, *self.notes]

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Probability of every option over its cost, the chosen one marked.

        Parameters
        ----------
        ax : Axes, optional
            Where to draw.
        label : str, optional
            Label of the options.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)
