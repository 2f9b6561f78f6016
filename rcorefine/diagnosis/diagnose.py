"""Which physical effect is missing, with a verdict that can be trusted."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_share
from ..arithmetic import own_arithmetic
from ..comparison.compare import compare
from ..data.channels import match_channels, record_for
from ..data.measurement import Measurement
from ..effects.effect import Effect, as_effects
from ..exceptions import DataError, IdentifiabilityWarning, ModelError
from ..inference.assembly import check_settings
from ..inference.fitted import Fitted, fitted_from
from ..inference.refinement import Refinement
from ..inference.sensitivities import Candidate, candidate_columns
from ..inference.starts import Motion
from ..inference.whitening import FTest, project
from ..inference.windows import as_records, check_validation, windows
from ..models.conversion import as_physical
from ..models.library import effect_library
from ..progress import Progress
from ..refinement.base_fit import base_fit
from .candidate_fits import Race, run_race, shortlist
from .excitation import no_motion, not_excited, record_remarks
from .holds import best_hold
from .remarks import amplitude_test, fit_remarks, remarks
from .residual_tests import Battery, run_battery
from .result import Detectable, Diagnosis, RankedEffect

__all__ = ["diagnose", "investigate"]

_OBSERVERS = (1.0, 0.1)  # a high gain follows the record, a low one tells rivals apart
_FORCES = (0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # unmeasured force over the measured one
_FORCES_AT = ("everywhere", "inputs")
_AS_LIKELY = 6.0  # log-likelihood within which another size of that force is as good
_FORCE_GAIN = 15.0  # log-likelihood that an unmeasured force must earn, or an effect beside one
_FORCE_BESIDE = 3.0  # the same beside an effect that fails without it: the battery decides
_HOPELESS = 1e-9  # p-value of the winner beside an unmeasured force below which it is not refitted there
_NOISE_EXCESS = 1.2  # residual over declared noise beyond which coloured noise is no excuse
_AMBIGUOUS = 9.2  # twice the log-likelihood within which rivals stay rivals
_POWER = 1.645  # 95 %
_DISAGREE = 0.005  # p-value below which two amplitudes refute a law
_SHORTEST = 200  # samples of a record that can be tested
_PAIRS = 3  # seconds that are tried for a hint


def diagnose(
    model: Any,
    data: Measurement | Sequence[Measurement],
    *,
    candidates: Sequence[Effect] | None = None,
    validation: Measurement | None = None,
    free: str | Sequence[Any] = (),
    tolerance: float = 0.0,
    offset: bool = True,
    noise: float | Sequence[float] | None = None,
    horizon: float | None = None,
    significance: float = 0.01,
    executor: Any = None,
    progress: bool = False,
) -> Diagnosis:
    """Find the physical effect that a model lacks.

    The model is fitted as far as it is declared to be free; its whitened residual must
    pass a battery of tests. If it does not, every candidate is scored on the motion that
    the record itself shows, the best are refitted, and the winner must pass the same
    battery.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement or list of Measurement
        Record, or several of the same system.
    candidates : sequence of Effect, optional
        What could be missing, default `effect_library(model)`.
    validation : Measurement, optional
        Record on which `fit_before` and `fit_after` are judged.
    free, tolerance, offset, noise, horizon
        As in `refine`: what of the linear model floats, the declared sensor noise, and the
        length of the free runs.
    significance : float
        Level of the gate: the rate of false alarms where nothing is missing.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Refits candidates in parallel.
    progress : bool
        Whether to show steps and remaining time on standard error.

    Returns
    -------
    Diagnosis
        Verdict, ranking, what cannot be told apart, every test.

    Raises
    ------
    DataError
        If the record is too short to test.
    ModelError
        If a candidate does not fit the model.

    Notes
    -----
    Score tests project every candidate off what was fitted; p-values are corrected for
    the number of candidates and of tests. Rivals are compared by their likelihood under
    the whitening filter of the best one.

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
    >>> found.verdict
    'adequate'
    """
    significance = as_share(significance, "significance")
    records = as_records(data)
    candidates = None if candidates is None else as_effects(candidates, "candidates")
    check_settings(
        as_physical(model), free=free, tolerance=tolerance, offset=offset, noise=noise, horizon=horizon
    )
    if validation is not None:
        check_validation(model, validation)
    with own_arithmetic(), Progress(progress, executor) as steps:
        with warnings.catch_warnings(), steps.step("model as it is"):
            warnings.simplefilter("ignore", IdentifiabilityWarning)
            base = base_fit(
                model, records, free=free, tolerance=tolerance, offset=offset, noise=noise, horizon=horizon
            )
        return investigate(
            base,
            records,
            asked=candidates,
            validation=validation,
            settings={
                "free": free,
                "tolerance": tolerance,
                "offset": offset,
                "noise": noise,
                "horizon": horizon,
                "candidates": None if candidates is None else tuple(candidates),
            },
            significance=significance,
            progress=steps,
        )[0]


def investigate(
    base: Refinement,
    records: Sequence[Measurement],
    *,
    asked: Sequence[Effect] | None,
    validation: Measurement | None,
    settings: dict[str, Any],
    significance: float,
    progress: Progress,
    thorough: bool = True,
) -> tuple[Diagnosis, Race | None]:
    """Diagnose a model that was fitted to the records already.

    Parameters
    ----------
    base : Refinement
        The model at its minimum.
    records : sequence of Measurement
        What it was fitted to.
    asked : sequence of Effect, or None
        Candidates; the library for None.
    validation, settings, significance
        As in `diagnose`; settings holds its options of fitting.
    progress : Progress
        What does the steps and counts them.
    thorough : bool
        Whether to try harder where no candidate passes, and pairs of them.

    Returns
    -------
    found : Diagnosis
    race : Race or None
        The refitted rivals, where there were any. Beside "adequate", unless `thorough`, those of
        a fault that few samples alone would show.
    """
    tolerance, noise, horizon = settings["tolerance"], settings["noise"], settings["horizon"]
    physical = base.physical_model
    ordered = [record_for(r, match_channels(physical.linear, r)) for r in records]
    for record in ordered:
        if record.n_samples < _SHORTEST:
            raise DataError(
                f"record {record.name!r} of {record.n_samples} samples is too short to test; "
                f"give at least {_SHORTEST}"
            )
    segments, _ = windows(physical, ordered, horizon)
    fitted = fitted_from(base, segments, tolerance=tolerance, noise=noise)
    motions = [Motion(fitted.structure, fitted.theta, record) for record in segments]
    if len(records) > 1:
        motions[0].companions = motions[1:]
    held = {(effect.kind, effect.place) for effect in base.effects}
    library = [
        effect
        for effect in (effect_library(physical) if asked is None else asked)
        if (effect.kind, effect.place) not in held
    ]
    if not library:
        raise ct.ControlArgument("no candidate is left that the model does not hold already")
    about: dict[str, Any] = {
        "base": base,
        "records": tuple(records),
        "significance": significance,
        "settings": settings,
    }
    still = no_motion(ordered) or not_excited(base, ordered)
    if still:
        unknown = Diagnosis(
            "ambiguous", (), tuple(library), (), (), (), force_ratio=0.0, notes=(still,), **about
        )
        return unknown, None
    with progress.step("tests"):
        scored = candidate_columns(fitted, library, motions[0], (0.0, *_OBSERVERS))
        free_run = Battery(fitted)
        tests = run_battery(free_run, scored, motions)
    gate = _overall(tests)
    loud = _excess(fitted, noise)
    if gate >= significance and loud <= _NOISE_EXCESS:
        adequate = _adequate(free_run, scored, tests, about)
        if thorough or _overall(tests, equal=True) >= significance:
            return adequate, None
        # few samples carry it, fault or noise: whoever holds another record asks the rivals there
        short = [scored[i] for i in shortlist(scored, [free_run])[0]]
        return adequate, run_race(fitted, short, progress=progress)
    forced: tuple[Battery, list[FTest]] | None = None
    forced_columns: list[Candidate] = []
    likely = _unmeasured_force(fitted, free_run) if loud <= _NOISE_EXCESS else []
    for led in progress.over(likely, "unmeasured force"):
        # how strong it is, and where, is not known: it explains the residual if one likely force does
        if _overall(run_battery(led, [], motions)) < significance:
            continue  # the library cannot mend what fails without it
        forced_columns = candidate_columns(led.fitted, library, motions[0], (led.ratio,))
        led_tests = run_battery(led, forced_columns, motions)
        if _overall(led_tests) >= significance:
            forced = led, led_tests
            break

    batteries = [free_run, *(Battery(fitted, r) for r in _OBSERVERS)]
    chosen, scores = shortlist(scored, batteries)
    race = run_race(fitted, [scored[i] for i in chosen], progress=progress)
    if race is None:
        return Diagnosis("unexplained", (), (), tuple(tests), (), (), force_ratio=0.0, **about), None
    with progress.step("tests"):
        judged = _judge(race, library, motions, significance, noise)
    if forced is not None and not _outweighs(judged, forced[0], 0.0):
        # an unmeasured force alone explains the residual: an effect beside it must earn its place
        beside = _beside_force(judged, library, motions, significance, noise)
        if beside is None or not _outweighs(beside, forced[0], _FORCE_GAIN):
            return _adequate(forced[0], forced_columns, forced[1], about), None
        judged = beside
    if not judged.passed:
        judged = _second_chance(
            judged, scored, chosen, library, motions, significance, noise, progress, thorough
        )
    race = judged.race
    likelihoods = np.array([r.log_likelihood for r in race.rivals])
    weights = np.exp(likelihoods - likelihoods[0])
    by_effect = {c.effect: test for c, test in zip(scored, scores, strict=True)}
    p_values = [by_effect[rival.effect].p_value for rival in race.rivals]
    ranking = _rows(race, p_values, weights / weights.sum(), base, validation, horizon)
    alike = tuple(
        rival.effect
        for rival, value in zip(race.rivals, likelihoods, strict=True)
        if 2 * (likelihoods[0] - value) <= _AMBIGUOUS + (0.0 if rival.settled else 2 * rival.lack)
    )
    notes = [*fit_remarks(race), *remarks(race, scored, batteries)]
    if thorough:
        options = {name: settings[name] for name in ("tolerance", "offset", "noise", "horizon")}
        with progress.step("holds"):
            _, sentence = best_hold(base, ordered, options)
        notes = [*([sentence] if sentence else []), *record_remarks(ordered), *notes]
    agreement, sentence = amplitude_test(race) if judged.passed and len(records) > 1 else (1.0, "")
    notes += [sentence] if sentence else []
    verdict = "effect" if len(alike) == 1 else "ambiguous"
    if not judged.passed or agreement < _DISAGREE:
        verdict = "unexplained"
        if thorough:
            with progress.step("pairs"):
                notes += _pair_hint(judged, scored, motions, significance, noise)
    found = Diagnosis(
        verdict,
        ranking,
        alike,
        tuple(tests),
        tuple(judged.tests),
        (),
        force_ratio=race.ratio,
        notes=tuple(notes),
        **about,
    )
    return found, race


def _pair_hint(
    judged: _Judged, scored: Sequence[Candidate], motions: Sequence[Motion], significance: float, noise: Any
) -> list[str]:
    """Whether the winner and one effect more would pass: flexible, so a hint and no verdict."""
    race = judged.race
    fitted = race.model()
    first = race.rivals[0].effect
    rest = [c.effect for c in scored if (c.effect.kind, c.effect.place) != (first.kind, first.place)]
    if not rest:
        return []
    second = candidate_columns(fitted, rest, motions[0], (0.0, *_OBSERVERS))
    tests = Battery(fitted).each(second)
    order = np.argsort([t.p_value for t in tests], kind="stable")[:_PAIRS]
    pair = run_race(fitted, [second[i] for i in order], race.ratio)
    if pair is None or not _judge(pair, rest, motions, significance, noise).passed:
        return []
    return [
        f"A pair would pass every test: {first.label} with {pair.rivals[0].effect.label}. Pairs are flexible "
        "enough to mimic what they are not; a record at another amplitude would tell."
    ]


@dataclass(eq=False)
class _Judged:
    """A race, and the battery on its winner."""

    race: Race
    tests: list[FTest]
    passed: bool


def _judge(
    race: Race, library: Sequence[Effect], motions: Sequence[Motion], significance: float, noise: Any
) -> _Judged:
    """The winner's residual through the same battery."""
    fitted = race.model()
    held = {(effect.kind, effect.place) for effect in fitted.structure.effects}
    rest = [effect for effect in library if (effect.kind, effect.place) not in held]
    moved = [Motion(fitted.structure, fitted.theta, motion.data) for motion in motions]
    try:
        scored = candidate_columns(fitted, rest, moved[0], (race.ratio,))
        tests = run_battery(Battery(fitted, race.ratio), scored, moved)
    except ModelError:  # its linear model runs away within one sample: what cannot be tested has not passed
        return _Judged(race, [], False)
    passed = _overall(tests) >= significance and _excess(fitted, noise) <= _NOISE_EXCESS
    return _Judged(race, tests, passed)


def _outweighs(judged: _Judged, forced: Battery, price: float) -> bool:
    """Whether a winner that passes is likelier than an unmeasured force alone."""
    if not judged.passed:
        return False
    own = Battery(judged.race.model(), judged.race.ratio).log_likelihood
    return own >= forced.log_likelihood + price


def _beside_force(
    first: _Judged, library: Sequence[Effect], motions: Sequence[Motion], significance: float, noise: Any
) -> _Judged | None:
    """The rivals with an unmeasured force beside them, where the winner then passes."""
    race = first.race
    winner = race.model()
    if _excess(winner, noise) > _NOISE_EXCESS:
        return None
    likely = _unmeasured_force(winner, Battery(winner), _FORCE_BESIDE)[:2]
    moved = [Motion(winner.structure, winner.theta, motion.data) for motion in motions] if likely else []
    for led in likely:
        if _overall(run_battery(led, [], moved)) < _HOPELESS:
            continue  # no refit mends that, and all rivals take long
        again = run_race(race.fitted.forced(led.fitted.force_at), [], led.ratio, entered=race.rivals)
        if again is not None:
            judged = _judge(again, library, motions, significance, noise)
            if judged.passed:
                return judged
    return None


def _second_chance(
    first: _Judged,
    scored: Sequence[Candidate],
    chosen: Sequence[int],
    library: Sequence[Effect],
    motions: Sequence[Motion],
    significance: float,
    noise: Any,
    progress: Progress,
    thorough: bool,
) -> _Judged:
    """What may be wrong when the winner fails: an unmeasured force, a stuck fit, a name left out."""
    race = first.race
    fitted = race.fitted
    beside = _beside_force(first, library, motions, significance, noise)
    if beside is not None:
        return beside
    rest = [c for i, c in enumerate(scored) if i not in set(chosen)]
    again = run_race(fitted, rest, entered=race.rivals, progress=progress)
    if again is not None and _ahead(again, race):
        judged = _judge(again, library, motions, significance, noise)
        if judged.passed:
            return judged
        first = judged
        race = again
    if not thorough:
        return _Judged(again, first.tests, False) if again is not None else first
    # what the winner's own residual points at counts among those that may be stuck
    pointed = [c for c in scored if any(t.name == f"library (most: {c.effect.label})" for t in first.tests)]
    stuck = list(dict.fromkeys([*(r.candidate for r in race.rivals[:3]), *pointed]))
    again = run_race(fitted, stuck, entered=race.rivals, thorough=True, progress=progress)
    if again is not None and _ahead(again, race):
        judged = _judge(again, library, motions, significance, noise)
        if judged.passed:
            return judged
    return first


def _ahead(again: Race, before: Race) -> bool:
    """Whether a race ended elsewhere than the one before: another winner, or the same one higher."""
    if again.rivals[0].effect != before.rivals[0].effect:
        return True
    # each has a filter of its own, so their levels are what compares
    levels = np.log(before.whitener.scales) - np.log(again.whitener.scales)
    return float(again.fitted.problem.n_points * np.mean(levels)) > 1.0


def _adequate(
    battery: Battery, scored: Sequence[Candidate], tests: Sequence[FTest], about: dict[str, Any]
) -> Diagnosis:
    """Nothing is missing; say what the record would have shown."""
    shown = _detectable(battery, scored, about["significance"])
    return Diagnosis("adequate", (), (), tuple(tests), (), shown, force_ratio=battery.ratio, **about)


def _overall(tests: Sequence[FTest], equal: bool = False) -> float:
    """Smallest p-value, corrected for the number of tests; of equally noisy samples if asked."""
    valid = [t.p_equal if equal else t.p_value for t in tests if t.dof]
    return min(1.0, min(valid, default=1.0) * len(valid))


def _excess(fitted: Fitted, noise: Any) -> float:
    """Residual over the declared noise, 0 where none was declared."""
    if noise is None:
        return 0.0
    residual = np.concatenate(fitted.residuals(), axis=1)
    return float(np.sqrt(np.mean(residual**2, axis=1)).max())


def _unmeasured_force(fitted: Fitted, free_run: Battery, least: float = _FORCE_GAIN) -> list[Battery]:
    """The residual led by each unmeasured force that it may speak of, the likeliest first."""
    found: list[Battery] = []
    for at in _FORCES_AT:
        top = -np.inf
        for ratio in _FORCES:
            try:
                led = Battery(fitted.forced(at), ratio)
            except (np.linalg.LinAlgError, ValueError):
                continue
            if np.isfinite(led.log_likelihood):
                found.append(led)
                top = max(top, led.log_likelihood)
            if not led.log_likelihood >= top - 3 * _AS_LIKELY:
                break  # it only falls from here
    best = max((led.log_likelihood for led in found), default=-np.inf)
    if best <= free_run.log_likelihood + least:
        return []
    near = [led for led in found if led.log_likelihood >= best - _AS_LIKELY]
    return sorted(near, key=lambda led: -led.log_likelihood)


def _rows(
    race: Race,
    p_values: Sequence[float],
    probabilities: Any,
    base: Refinement,
    validation: Measurement | None,
    horizon: float | None,
) -> tuple[RankedEffect, ...]:
    before = _validated(base, validation, horizon)
    rows = []
    for i, (rival, p, probability) in enumerate(zip(race.rivals, p_values, probabilities, strict=True)):
        refinement = race.model(i).refinement
        own = [
            row
            for row in refinement.parameters
            if row.kind == rival.effect.kind and row.place == rival.effect.place
        ]
        names = [name for name in rival.effect.coefficients if name not in rival.effect.fixed]
        rows.append(
            RankedEffect(
                effect=rival.effect,
                coefficients={n: row.coefficient for n, row in zip(names, own, strict=True)},
                std={n: row.std for n, row in zip(names, own, strict=True)},
                fit_before=before,
                fit_after=_validated(refinement, validation if i < 8 else None, horizon),
                p_value=float(p),
                probability=float(probability),
                log_likelihood_gain=rival.log_likelihood - race.base_log_likelihood,
                refinement=refinement,
            )
        )
    return tuple(rows)


def _validated(refinement: Refinement, validation: Measurement | None, horizon: float | None) -> float:
    """Mean fit on the validation record, or on the fitted one where there is none."""
    if validation is None:
        return float(np.mean(refinement.fit))
    return float(np.mean(compare(refinement, validation, horizon=horizon).fit))


def _detectable(battery: Battery, scored: Sequence[Candidate], significance: float) -> tuple[Detectable, ...]:
    """Smallest coefficient of each one-coefficient candidate that the library test would have shown."""
    from scipy.stats import norm

    level = norm.isf(significance / (2 * 6 * max(len(scored), 1))) + _POWER
    found = []
    for candidate in scored:
        if len(candidate.effect.coefficients) != 1 or len(candidate.starts) != 1:
            continue
        white = battery.whiten(candidate.columns[battery.ratio])
        column = project(white[:, 0], battery.basis)
        size = float(np.linalg.norm(column))
        if size > 1e-9 * max(float(np.linalg.norm(white[:, :1])), 1e-300):
            parameter = candidate.problem.structure.parameters[-1]
            unit = candidate.problem.structure.unit(parameter)
            # more where the column is large on samples that are noisier than the rest
            spread = max(1.0, float(np.linalg.norm(column * battery.left)) / size)
            found.append(Detectable(candidate.effect, parameter.name, level * spread / size, unit))
    return tuple(found)
