"""Search for the failures of a model, in one table.

The table covers time, frequency, amplitude, state space and place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from ...exceptions import own_arithmetic
from ...inference.levels import levels
from ...results import Result, Row
from ...systems.linear import Array
from .amplitude import distortions, input_laws, level_dependence
from .frequency import bands, modes
from .likelihood import ResidualLikelihood
from .record import DIMENSIONS, Finding, ModelOnRecord
from .state import forces_at_places
from .time import clipping, delays, drifts, pinned, signs, stretches

if TYPE_CHECKING:
    from ..result import Comparison


# Share of the leader's part of the error from which on another row counts as a view of the same ...
_RIVAL = 0.5
# ... and from which on it comes before a mere place.
_EQUAL = 0.9
_SOME = 0.1  # ... of the best row of its dimension
_MUCH = 4.0
_REMAINS = 0.02  # of its worth: what a row may add to the leader that causes it
_BESIDES = 2
_SHOWN = 10


@dataclass(frozen=True, slots=True, eq=False)
class Failure(Row):
    """One row of a failure map.

    Attributes
    ----------
    dimension : str
        "time", "frequency", "amplitude", "state" or "place".
    where : str
        Region: a stretch of time, a mode or band, a level, a side, a port.
    measure : str
        What departs: delay, dropout, mode, residual force, ...
    statistic : float
        Twice the log-likelihood that allowing for it adds to the record.
    p_value : float
        Probability of such a row anywhere in the map if the model is right,
        the number of regions looked at allowed for.
    share : float
        Share of the error's energy that it explains, 0 to 1. Rows overlap,
        so that shares do not add up to one.
    sentence : str
        What it means.
    role : str
        "first"; "besides" for what is left when the rows before are allowed
        for; "instead" for another view of the same error.
    values : dict
        The region and what was found, as numbers.
    """

    dimension: str
    where: str
    measure: str
    statistic: float
    p_value: float
    share: float
    sentence: str
    role: str
    values: dict[str, Any]

    @property
    def mark(self) -> str:
        """Sign of the role: 1 for the first, + for besides, = for instead."""
        return {"first": "1", "besides": "+", "instead": "="}[self.role]

    def __str__(self) -> str:
        return f"{self.dimension}: {self.where}: {self.sentence}"


@dataclass(frozen=True, slots=True, eq=False)
class FailureMap(Result):
    """Failures of one model on a record, most important row first.

    Behaves as a sequence of its rows; empty where nothing is significant.

    Attributes
    ----------
    name : str
        Model.
    rows : tuple of Failure
        Failures.
    residual_rms : ndarray of shape (n_y,)
        Error of the free run, in the outputs' units.
    looked : tuple of str
        Dimensions that were searched.
    notes : tuple of str
        What could not be searched, and why.
    """

    name: str
    rows: tuple[Failure, ...]
    residual_rms: Array
    looked: tuple[str, ...]
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Failure]:
        return iter(self.rows)

    def __getitem__(self, index: int) -> Failure:
        return self.rows[index]


@own_arithmetic()
def failure_map(comparison: Comparison, index: int) -> FailureMap:
    """Search for where one model of a comparison fails.

    Parameters
    ----------
    comparison : Comparison
        Models on a record.
    index : int
        Which of the models.

    Returns
    -------
    FailureMap

    Notes
    -----
    Every region is an explanation of part of the residual: a pole moved, a
    band rescaled, a delay, a force over displacement or velocity at a port.
    Its worth is the log-likelihood that it adds when the noise, an
    autoregressive process, is estimated anew from what it leaves; so
    coloured noise is no failure, and the explanation that leaves least
    structure leads. The noise model of the leader is then used to judge all
    once more. p-values are multiplied by the number of regions (Bonferroni).
    """
    rms, data = np.atleast_2d(comparison.rmse)[index], comparison.data
    if data.there is not None:
        gap = data.output_labels[int(np.argmin(data.there.all(axis=1)))]
        said = (
            f"{gap} has samples that were not measured; failures are searched in whole records, use diagnose"
        )
        return FailureMap(comparison.names[index], (), rms, (), (said,))
    scene = ModelOnRecord(comparison, index)
    notes: list[str] = []
    rows: tuple[Failure, ...] = ()
    looked: tuple[str, ...] = ()
    if scene.places is None:
        notes.append("State space and place were not searched: no places were found in this model")
    if scene.n_samples < 60:
        notes.append(f"{scene.n_samples} samples are too few to search for regions; give at least 60")
    elif comparison.led or comparison.looped:
        notes.append(
            f"The model {'runs in a loop' if comparison.looped else 'is unstable'} and is corrected by the "
            "record, so failures cannot be located; use diagnose"
        )
    elif scene.evidence.is_rounding:
        notes.append("Beside initial states and offsets, the model differs from the record by rounding only")
    # search all regions with the same likelihood
    else:
        rows, looked = _rows(scene), DIMENSIONS if scene.places else DIMENSIONS[:3]
    return FailureMap(comparison.names[index], rows, rms, looked, tuple(notes))


_OF_OUTPUTS = (stretches, drifts, delays, signs, clipping, pinned, modes, bands)
_OF_CAUSES = (input_laws, level_dependence, distortions, forces_at_places)


def _search_all(scene: ModelOnRecord) -> list[Finding]:
    """All findings under the present noise model."""
    return [finding for search in _OF_OUTPUTS + _OF_CAUSES for finding in search(scene)]


def _p_value(finding: Finding, scene: ModelOnRecord, count: int) -> float:
    """Likelihood ratio as an F-test, times the number of regions."""
    # F statistic from the likelihood ratio; Bonferroni over the regions searched
    n = scene.n_samples - scene.evidence.order
    gain = finding.explanation.gain
    if gain <= 0:
        return 1.0
    free = n - finding.dof - scene.evidence.order
    ratio = np.expm1(min(gain / n, 500.0)) * free / finding.dof
    return float(min(1.0, stats.f.sf(ratio, finding.dof, free) * count))


def _rows(scene: ModelOnRecord) -> tuple[Failure, ...]:
    """Return the significant rows of the table.

    The leading row comes first, then rows that add to it, then alternatives to it.
    """
    whole = scene.evidence
    # first as if the noise were nothing, then with the noise that the leader leaves
    whole.use_white()
    findings = _search_all(scene)
    count = 2 * sum(f.tried for f in findings)
    leaders = _in_order(_significant(findings, scene, count), scene)
    # second pass: noise model of what the leader leaves
    whole.use(scene.residual - (leaders[0].explanation.fit if leaders else 0.0))
    ranked = _rank(findings + _search_all(scene), scene, count)
    if not ranked:
        return ()
    besides = _search_rest(scene, ranked[0], count)
    scene.evidence = whole
    roles = [(ranked[0], "first"), *((f, "besides") for f in besides)]
    roles += [(f, "instead") for f in _other_views(ranked, whole)]
    return tuple(
        Failure(
            f.dimension, f.where, f.measure, f.explanation.gain, _p_value(f, scene, count),
            whole.share_of_error(whole.whole(f.explanation)), f.sentence, role, f.values,
        )
        for f, role in roles[:_SHOWN]
    )  # fmt: skip


def _search_rest(scene: ModelOnRecord, leader: Finding, count: int) -> list[Finding]:
    """Look for up to two more failures in what the leading one leaves."""
    whole, found = scene.evidence, [leader]
    fit, all_of_it = leader.explanation.fit, whole.whole(leader.explanation)

    def more(f: Finding) -> float:
        """Share of the error that a finding explains besides those before."""
        besides = whole.share(fit + f.explanation.fit) - whole.share(fit)
        part = scene.evidence.share_of_error(scene.evidence.whole(f.explanation))
        return max(besides, part * (1.0 - whole.share_of_error(all_of_it)))

    least = levels().failure_besides
    for _ in range(_BESIDES):
        if max(1.0 - whole.share(fit), 1.0 - whole.share_of_error(all_of_it)) < least:
            break  # nothing is left that could count
        scene.evidence, scene.known, scene.laws = whole.after(fit, all_of_it), {}, None
        shown = [_region(f) for f in found]
        ranked = [f for f in _rank(_search_all(scene), scene, count) if f.dimension != "place"]
        best = next((f for f in ranked if _region(f) not in shown and more(f) >= least), None)
        if best is None:
            break
        found.append(best)
        fit, all_of_it = fit + best.explanation.fit, all_of_it + scene.evidence.whole(best.explanation)
    return found[1:]


def _other_views(ranked: Sequence[Finding], whole: ResidualLikelihood) -> Iterator[Finding]:
    """Yield other views of the failure that leads.

    These are the best row of each dimension, and what explains nearly as much as the leader.
    """
    leader = ranked[0]
    lead, dimensions = whole.share(leader.explanation.fit), {leader.dimension}
    for f in ranked[1:]:
        least = _RIVAL if f.dimension in dimensions else _SOME
        if whole.share(f.explanation.fit) >= least * lead and not _is_consequence(f, leader, whole):
            dimensions.add(f.dimension)
            yield f


def _is_consequence(f: Finding, leader: Finding, whole: ResidualLikelihood) -> bool:
    """Return whether a row is only a consequence of the leading row.

    Such a row explains nothing in addition to the leading row. The leading row explains more in addition to
    it, or the same with fewer parameters. Bands and places only describe where the error lies, so they stay.
    """
    if f.dimension == "place" or f.measure == "band":
        return False
    price = float(np.log(whole.n_samples))

    # likelihood gain of one finding after the other is taken out
    def more(one: Finding, than: Finding) -> float:
        left = whole.after(than.explanation.fit, than.explanation.fit)
        return left.linear([one.explanation.fit]).gain

    if more(f, leader) > max(f.dof * price, _REMAINS * f.explanation.gain):
        return False
    return more(leader, f) > leader.dof * price or (f.dimension == leader.dimension and f.dof > leader.dof)


def _significant(findings: Sequence[Finding], scene: ModelOnRecord, count: int) -> list[Finding]:
    """Return the findings that pass the level of the map."""
    return [f for f in findings if _p_value(f, scene, count) < levels().failure]


def _rank(findings: Sequence[Finding], scene: ModelOnRecord, count: int) -> list[Finding]:
    """Best finding of each kind of region, significant ones only, best first."""
    best: dict[tuple[str, ...], Finding] = {}
    # best finding in each region
    for finding in _in_order(_significant(findings, scene, count), scene):
        best.setdefault(_region(finding), finding)
    ranked, share = list(best.values()), scene.evidence.share
    # a place is another view of what the others show: it leads only if none explains 90 % as much
    if ranked and ranked[0].dimension == "place":
        least = _EQUAL * share(ranked[0].explanation.fit)
        others = [f for f in ranked if f.dimension != "place" and share(f.explanation.fit) >= least]
        ranked.sort(key=lambda f: f not in others[:1])
    return ranked


def _in_order(findings: Sequence[Finding], scene: ModelOnRecord) -> list[Finding]:
    """Sort the findings by their gain in likelihood.

    A finding that leaves several times as much of the error as another cannot come before it. The likelihood
    treats a slow error as colored noise, so the share of the error that is explained counts, too.
    """
    # share of the error that each finding leaves
    left = [1.0 - scene.evidence.share(f.explanation.fit) for f in findings]
    bound = _MUCH * min(left, default=0.0) + 0.01
    order = sorted(range(len(findings)), key=lambda k: (left[k] > bound, -findings[k].net(scene)))
    return [findings[k] for k in order]


def _region(finding: Finding) -> tuple[str, ...]:
    """Return a key that is equal for findings in the same region.

    Of several findings in one region only the best is shown.
    """
    v, kind = finding.values, str(finding.values.get("kind", finding.measure))
    if finding.dimension == "time" and "span" in v:
        return "time", "stretch", str(v["output"]), str(round(v["span"][0] / 20))
    if kind == "mode":
        return "frequency", "mode", str(v["modes"][0]["mode"])
    owner = v.get("place") or v.get("input") or v.get("output") or ""
    if finding.dimension == "amplitude":
        kind = kind + str(v.get("parity", "")) if kind in ("level", "distortion") else "input"
    return finding.dimension, kind, str(owner)
