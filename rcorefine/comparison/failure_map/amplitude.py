"""Failures in amplitude: nonlinear inputs, level dependence, distortion.

A nonlinear input acts less or more than in proportion to its value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.signal import hilbert

from ...results import frequency_text
from ...systems.linear import Array
from .frequency import band_columns, excited_lines
from .likelihood import Explanation
from .record import Finding, ModelOnRecord

_Law = Callable[[Array, float], Array]
_Shapes = tuple[tuple[str, _Law, str], ...]  # name, formula, region
# What an input does beside the model's input where it has a level g, and the region.
_LEVELS: _Shapes = (
    ("dead zone", lambda w, g: -np.clip(w, -g, g), "|{n}| < {g}"),
    ("saturation", lambda w, g: np.clip(w, -g, g) - w, "|{n}| > {g}"),
)
# The same without a level; the spread of the input keeps the unit.
_SHAPES: _Shapes = (
    ("asymmetry", lambda w, spread: np.abs(w), "the two signs of {n}"),
    ("odd distortion", lambda w, spread: w**3 / spread**2, "large |{n}|"),
    ("even distortion", lambda w, spread: w**2 / spread, "large |{n}|"),
)
# An input of one sign has no sides.
_ONE_SIDED: _Shapes = (("curvature", lambda w, spread: w**2 / spread, "large |{n}|"),)
_SENTENCES = {
    "dead zone": "Small values of {n} (below {g}) have less effect than in the model: a dead zone.",
    "saturation": "Values of {n} beyond {g} have less effect than in the model: the actuator saturates.",
    "asymmetry": "The gain of {n} differs between positive and negative values.",
    "odd distortion": "The gain of {n} changes at large values, equally for both signs.",
    "even distortion": "The effect of {n} has a quadratic part: it has the same direction for both signs.",
    "curvature": "The gain of {n} differs between large and small values.",
}
#: Names and sentences where the effect is larger than in the model.
_LARGER = {
    "dead zone": ("larger gain below", "Small values of {n} (below {g}) have more effect than in the model."),
    "saturation": ("larger gain beyond", "Values of {n} beyond {g} have more effect than in the model."),
}
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
            # candidate shapes: with a level found by search, and without one
            every = (*_with_level(scene, j), *_with_shape(scene, j))
            found += [finding for finding in every if finding.explanation.gain > least]
    return found


def _with_level(scene: ModelOnRecord, j: int) -> Iterator[Finding]:
    w, name, unit = scene.data.inputs[j], scene.data.input_labels[j], scene.data.input_units[j]
    # levels from the 5th to the 98th percentile of |w|
    levels = np.unique(np.quantile(np.abs(w), np.linspace(0.05, 0.98, 24)))
    levels = levels[levels > 0]
    if levels.size < 3:
        return
    for kind, law, where in _LEVELS:

        def acting(values: Array, law: _Law = law) -> Array:
            return np.array(scene.driven([(j, law(w, g)) for g in values]))

        # gain of the shape by least squares, its level by a search in one dimension
        explanation = scene.evidence.searched(acting, levels[::2], scaled=True)
        factor, g = map(float, explanation.values)
        text = {"n": name, "g": f"{g:.3g} {unit}".rstrip()}
        measure, sentence = (kind, _SENTENCES[kind]) if factor > 0 else _LARGER[kind]
        values = {"input": name, "level": g, "factor": factor, "kind": measure}
        where, sentence = where.format(**text), sentence.format(**text)
        yield Finding("amplitude", where, measure, explanation, 2, 12, sentence, values)


def _with_shape(scene: ModelOnRecord, j: int) -> Iterator[Finding]:
    w, name = scene.data.inputs[j], scene.data.input_labels[j]
    # share of the energy at positive values: below 1 or above 99 % the input has one sign
    energy = float(np.sum(np.maximum(w, 0.0) ** 2)) / float(w @ w)
    shapes = _SHAPES if _OTHER_SIGN < energy < 1.0 - _OTHER_SIGN else _ONE_SIDED
    columns = scene.driven([(j, shape(w, float(w.std()))) for _, shape, _ in shapes])
    for (kind, _, where), column in zip(shapes, columns, strict=True):
        explanation = scene.evidence.linear([column])
        values, text = {"input": name, "kind": kind}, _SENTENCES[kind]
        yield Finding("amplitude", where.format(n=name), kind, explanation, 1, 3, text.format(n=name), values)


def level_dependence(scene: ModelOnRecord) -> list[Finding]:
    """Bands in which gain or phase change with the level of the response."""
    found = []
    # bands of the simulated output that hold 96 % of its energy
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
        # modulate each band by its squared envelope (Hilbert transform)
        modulated = []
        for k in range(centers.size):
            pair = plain[2 * k : 2 * k + 2]
            level = np.abs(hilbert(pair[0][i])) ** 2
            level = level / max(float(level.mean()), 1e-300) - 1.0
            modulated.append([column * level for column in pair])
        # test the modulated columns beside the plain ones
        base = scene.evidence.linear(plain)
        singles = [scene.evidence.linear([*plain, *pair]) for pair in modulated]
        k = int(np.argmax([explanation.gain for explanation in singles]))
        every = scene.evidence.linear([*plain, *(c for pair in modulated for c in pair)])
        dof = 2
        best = singles[k]
        # one band, or all where that explains clearly more
        if every.gain - best.gain > 8 * np.log(scene.n_samples):
            best, dof = every, 10
        own = Explanation(best.fit - base.fit, best.gain - base.gain, best.values)
        name, near = scene.named(i), frequency_text(float(centers[k]))
        text = (
            f"Near {near} the response of {name} is not proportional to its level, so the system is "
            "nonlinear there."
        )
        values, where = {"output": name, "omega": float(centers[k]), "kind": "level"}, f"{name} near {near}"
        found.append(Finding("amplitude", where, "level dependence", own, dof, centers.size, text, values))
    return found


def distortions(scene: ModelOnRecord) -> list[Finding]:
    """Find distortion at harmonics that a periodic input does not contain.

    Even and odd harmonics are separate findings (Pintelon and Schoukens).
    """
    lines = excited_lines(scene.data.inputs)
    if lines is None or len(scene.starts) > 1:
        return []
    period, excited, base = lines
    # harmonics of the base frequency that the input does not contain, up to 5 times the highest
    harmonic = np.arange(excited.size) / base
    reached = ~excited & (harmonic > 0) & (harmonic <= 5 * harmonic[excited].max())
    found = []
    for parity, word, shape in ((0, "even", "is asymmetric"), (1, "odd", "is the same on both sides")):
        # even and odd harmonics separately
        wanted = reached & (harmonic % 2 == parity)
        for i in range(scene.n_outputs if wanted.any() else 0):
            r, name = scene.residual[i], scene.named(i)
            whole = r.size // period - 1  # the first period settles
            # mean over whole periods: noise averages out, distortion remains
            spectrum = np.fft.rfft(r[r.size - whole * period :].reshape(whole, period).mean(axis=0))
            wave = np.fft.irfft(np.where(wanted, spectrum, 0.0), period)
            fit = scene.only(i, np.tile(wave, whole + 2)[(whole + 2) * period - r.size :])
            level = 20.0 * np.log10(max(float(wave.std() / max(scene.measured[i].std(), 1e-300)), 1e-12))
            text = (
                f"{name} contains {word} harmonics that the input does not ({level:.0f} dB of its level): a "
                f"nonlinearity that {shape}."
            )
            explanation = Explanation(fit, scene.evidence.gain(fit), np.array([level]))
            values = {"output": name, "level_dB": level, "kind": "distortion", "parity": word}
            where, measure, dof = f"{word} harmonics at {name}", f"{word} distortion", 2 * int(wanted.sum())
            found.append(Finding("amplitude", where, measure, explanation, dof, 2, text, values))
    return found
