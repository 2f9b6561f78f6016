"""Choice of the effect that an exercise hides.

The effect is large enough, unlike every other candidate, and found by a diagnosis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rcorefine import Diagnosis, Effect, Measurement, PhysicalModel, diagnose, simulate

from ..arguments import Array
from ..exceptions import DivergenceError, ModelError, unheard
from .plants import ExercisePlant, record_of

#: Share of the outputs that the model misses, and the noise of the sensors.
LEVELS = {1: (0.30, 0.01), 2: (0.15, 0.02), 3: (0.08, 0.03)}

SAMPLES, TRAINING = 3000, 2 / 3
_STEPS, _NEAR = 15, 0.15  # of the search for a size, and how near to the wanted loss is enough
_APART = 100.0  # squared distance to every rival in standard deviations: a swap in one of 3 million
_TRIALS = 3  # diagnoses at most
_SHARP = 1e-3  # of the speed: the width of sgn(v) in the plant
_MOST_LOST = 0.8  # of a number of the model: what is lost leaves something
_TOLERANCE, _SPREAD = 0.1, 4.0  # of a coefficient: a share, or so many standard deviations


@dataclass(frozen=True, slots=True)
class Accepted:
    """Accepted answer: the hidden effect, or an indistinguishable one.

    The record cannot distinguish the latter from the hidden effect.
    """

    effect: Effect
    coefficient: float
    tolerance: float
    tied: bool


@dataclass(frozen=True, slots=True)
class Hidden:
    """Two records of a plant that lacks something, and the answers that count."""

    train: Measurement
    test: Measurement
    accepted: tuple[Accepted, ...]


@dataclass(frozen=True, slots=True)
class _Offer:
    effect: Effect
    coefficient: float
    outputs: Array
    change: Array  # of the outputs, in standard deviations of the noise, free of its mean


def hide(
    plant: ExercisePlant, model: PhysicalModel, candidates: Sequence[Effect], level: int, seed: Sequence[int]
) -> Hidden:
    """Hide one of the candidates in a record of the plant.

    Parameters
    ----------
    plant : ExercisePlant
        How it is excited.
    model : PhysicalModel
        Its linear model.
    candidates : sequence of Effect
        What may be hidden, and is sought.
    level : int
        Key of `LEVELS`.
    seed : sequence of int
        Seed of the generator.

    Returns
    -------
    Hidden

    Raises
    ------
    ModelError
        If nothing that was tried could be found again.
    """
    loss, noise = LEVELS[level]
    rng = np.random.default_rng(seed)
    blank = plant.excited(model, SAMPLES, rng)
    plain = simulate(model, blank, "zero").outputs
    sizes = noise * plain.std(axis=1, keepdims=True)
    speeds = _speeds(model, blank)
    offers = []
    for effect in candidates:
        if len(effect.coefficients) == 1:
            sized = _sized(model, effect, blank, plain, loss, rng, speeds)
            if sized is not None:
                change = (sized[1] - plain) / sizes
                offers.append(_Offer(effect, *sized, change - change.mean(axis=1, keepdims=True)))
    alone = [offer for offer in offers if _distance(offer, offers) > _APART]
    for offer in [alone[i] for i in rng.permutation(len(alone))[:_TRIALS]]:
        y = offer.outputs
        y = y + noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
        data = record_of(model, blank.inputs, y, dt=plant.dt)
        train, test = data.split(TRAINING)
        with unheard():  # they may name it
            accepted = _accepted(diagnose(model, train, candidates=candidates), offer)
        if accepted:
            return Hidden(train, test, accepted)
    raise ModelError("nothing that this seed hides could be found again; take another seed, or a lower level")


def _sized(
    model: PhysicalModel,
    effect: Effect,
    blank: Measurement,
    plain: Array,
    loss: float,
    rng: np.random.Generator,
    speeds: Mapping[str, float],
) -> tuple[float, Array] | None:
    """Return a coefficient of an effect, and the outputs with it, or None.

    With this coefficient, the model misses about the share `loss` of the outputs.
    """
    (name,), width = effect.coefficients, {}
    if effect.spec.jumps:
        width = {"width": _SHARP * speeds[effect.place]}
    size = float(np.linalg.norm(plain.std(axis=1)))
    known = [p.value for p in model.parameters if (p.kind, p.place) == (effect.kind, effect.place)]
    own = list(filter(None, known))
    lower = effect.bounds(effect.coefficients[0])[0]
    sign = -1.0 if rng.random() < 0.5 and ((own and lower < 0) or lower == -1.0) else 1.0
    value = 0.1 * abs(own[0]) if own else 0.137
    for _ in range(_STEPS):
        try:
            hidden = effect.replace(fixed={name: sign * value, **width})
            outputs = simulate(model, blank, "zero", effects=[hidden]).outputs
        except (DivergenceError, ModelError):  # it runs away, or a mass is gone
            value /= 30.0
            continue
        missed = float(np.linalg.norm((outputs - plain).std(axis=1))) / size
        if abs(missed / loss - 1.0) < _NEAR:
            lost = sign < 0 and value > _MOST_LOST * abs(own[0] if own else 1.0)
            return None if lost else (sign * value, outputs)
        value *= min(max((loss / max(missed, 1e-12)) ** 0.8, 1e-3), 1e3)
    return None


def _speeds(model: PhysicalModel, blank: Measurement) -> dict[str, float]:
    """Typical size of the motion at each port."""
    states = simulate(model, blank, "zero").states
    return {
        port.name: float(np.std(port.velocity @ states + port.velocity_input @ blank.inputs))
        for port in model.ports
        if port.has_velocity
    }


def _distance(offer: _Offer, offers: Sequence[_Offer]) -> float:
    """Return the squared output distance to the nearest other candidate.

    That candidate may have any size.
    """
    own = offer.change.ravel()
    left = [own @ own]
    for other in offers:
        if other is not offer:
            theirs = other.change.ravel()
            left.append(own @ own - (own @ theirs) ** 2 / (theirs @ theirs))
    return float(min(left))


def _accepted(found: Diagnosis, offer: _Offer) -> tuple[Accepted, ...]:
    """Return the accepted answers after a diagnosis.

    The diagnosis must name the hidden effect, or tie it; otherwise the result is empty.
    """
    if found.verdict not in ("effect", "ambiguous") or offer.effect not in found.ambiguous:
        return ()
    accepted = []
    for row in found.ranking:
        if row.effect in found.ambiguous and len(row.coefficients) == 1:
            ((name, value),) = row.coefficients.items()
            true = row.effect == offer.effect
            center = offer.coefficient if true else value
            tolerance = max(_TOLERANCE, _SPREAD * row.std[name] / abs(center))
            if true and abs(value - center) > tolerance * abs(center):
                return ()
            accepted.append(Accepted(row.effect, center, tolerance, not true))
    return tuple(accepted)
