"""Failures in amplitude: nonlinear inputs, responses that do not scale.

A nonlinear input acts less or more than in proportion to its value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.signal import hilbert

from ...systems.linear import Array
from ...words import frequency_text
from .bands import band_columns
from .likelihood import Explanation
from .record import Finding, ModelOnRecord

__all__ = ["input_laws", "level_dependence"]


# What an input does beside the model's input where it has a level g, the region and what that means.
_LEVELS: tuple[tuple[str, Callable[[Array, float], Array], str, str], ...] = (
    (
        "dead zone",
        lambda w, g: -np.clip(w, -g, g),
        "|{n}| < {g}",
        "Small values of {n} (below {g}) have less effect than in the model: a dead zone.",
    ),
    (
        "saturation",
        lambda w, g: np.clip(w, -g, g) - w,
        "|{n}| > {g}",
        "Values of {n} beyond {g} have less effect than in the model: the actuator saturates.",
    ),
)
# The same without a level; the spread of the input keeps the unit.
_SHAPES: tuple[tuple[str, Callable[[Array, float], Array], str, str], ...] = (
    (
        "asymmetry",
        lambda w, spread: np.abs(w),
        "the two signs of {n}",
        "The gain of {n} differs between positive and negative values.",
    ),
    (
        "odd distortion",
        lambda w, spread: w**3 / spread**2,
        "large |{n}|",
        "The gain of {n} changes at large values, equally for both signs.",
    ),
    (
        "even distortion",
        lambda w, spread: w**2 / spread,
        "large |{n}|",
        "The effect of {n} has a quadratic part: it has the same direction for both signs.",
    ),
)
# An input of one sign has no sides.
_ONE_SIDED: tuple[tuple[str, Callable[[Array, float], Array], str, str], ...] = (
    (
        "curvature",
        lambda w, spread: w**2 / spread,
        "large |{n}|",
        "The gain of {n} differs between large and small values.",
    ),
)
_OTHER_SIGN = 0.01  # of an input's energy: with less of it, the input has one sign


def input_laws(scene: ModelOnRecord) -> list[Finding]:
    """Find static nonlinearities at each input.

    They are dead zone, saturation, unequal sides, and odd and even distortion.
    """
    found = []
    for j, w in enumerate(scene.data.inputs):
        if np.ptp(w) != 0.0:
            # what says no more than this is but the gain
            least = scene.evidence.linear(scene.driven([(j, w)])).gain + float(np.log(scene.n_samples))
            every = (*_with_level(scene, j), *_with_shape(scene, j))
            found += [finding for finding in every if finding.explanation.gain > least]
    return found


def _with_level(scene: ModelOnRecord, j: int) -> Iterator[Finding]:
    w, name, unit = scene.data.inputs[j], scene.data.input_labels[j], scene.data.input_units[j]
    levels = np.unique(np.quantile(np.abs(w), np.linspace(0.05, 0.98, 24)))
    levels = levels[levels > 0]
    if levels.size < 3:
        return
    for kind, law, where, sentence in _LEVELS:

        def shape(g: float, law: Callable[[Array, float], Array] = law) -> Array:
            return scene.driven([(j, law(w, g))])[0]

        one = scene.evidence.searched(shape, levels[::2], scaled=True)
        g = float(one.values[-1])
        text = {"n": name, "g": f"{g:.3g}{' ' + unit if unit else ''}"}
        values = {"input": name, "level": g, "factor": float(one.values[0]), "kind": kind}
        yield Finding("amplitude", where.format(**text), kind, one, 2, 12, sentence.format(**text), values)


def _with_shape(scene: ModelOnRecord, j: int) -> Iterator[Finding]:
    w, name = scene.data.inputs[j], scene.data.input_labels[j]
    energy = float(np.sum(np.maximum(w, 0.0) ** 2)) / float(w @ w)
    shapes = _SHAPES if _OTHER_SIGN < energy < 1.0 - _OTHER_SIGN else _ONE_SIDED
    columns = scene.driven([(j, shape(w, float(w.std()))) for _, shape, _, _ in shapes])
    for (kind, _, where, sentence), column in zip(shapes, columns, strict=True):
        yield Finding(
            "amplitude", where.format(n=name), kind, scene.evidence.linear([column]), 1, 3,
            sentence.format(n=name), {"input": name, "kind": kind},
        )  # fmt: skip


def level_dependence(scene: ModelOnRecord) -> list[Finding]:
    """Bands in which gain or phase change with the level of the response."""
    found = []
    for i in range(scene.n_outputs):
        run = scene.run[i] - scene.run[i].mean()
        energy = np.abs(np.fft.rfft(run)) ** 2
        omega = 2.0 * np.pi * np.fft.rfftfreq(scene.n_samples, scene.dt)
        share = np.cumsum(energy) / max(float(energy.sum()), 1e-300)
        low, high = (float(np.interp(q, share, omega)) for q in (0.02, 0.98))
        if not 0 < low < high or scene.n_samples < 200:
            continue
        centers = np.geomspace(low, high, 5)
        plain = band_columns(scene, i, centers)
        modulated = []
        for k in range(centers.size):
            pair = plain[2 * k : 2 * k + 2]
            level = np.abs(hilbert(pair[0][i])) ** 2
            level = level / max(float(level.mean()), 1e-300) - 1.0
            modulated.append([column * level for column in pair])
        base = scene.evidence.linear(plain)
        singles = [scene.evidence.linear([*plain, *pair]) for pair in modulated]
        k = int(np.argmax([one.gain for one in singles]))
        every = scene.evidence.linear([*plain, *(c for pair in modulated for c in pair)])
        dof = 2
        best = singles[k]
        if every.gain - best.gain > 8 * np.log(scene.n_samples):
            best, dof = every, 10
        own = Explanation(best.fit - base.fit, best.gain - base.gain, best.values)
        name = scene.named(i)
        near = frequency_text(float(centers[k]))
        found.append(
            Finding(
                "amplitude", f"{name} near {near}", "level dependence", own, dof, centers.size,
                f"Near {near} the response of {name} is not proportional to its level, so the system is "
                "nonlinear there.",
                {"output": name, "omega": float(centers[k]), "kind": "level"},
            )
        )  # fmt: skip
    return found
