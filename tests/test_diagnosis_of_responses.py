"""Frequency responses through compare, refine, diagnose and improve: dynamic stiffness, point by point."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import slow
from scipy.optimize import root

import rcorefine as rco

effect = rco.Effect
M, C, K = (1.0, 0.6), (0.5, 0.3), (120.0, 90.0)
OMEGA = np.geomspace(2.0, 60.0, 220)
LABELS = {"input_labels": "force", "output_labels": ["q1", "q2"]}


def model():
    return rco.mass_spring_damper(M, C, K, sensors="displacement")


def receptance(omega=OMEGA, m=M, c=C, k=K, loss=0.0, absorber=None):
    """Displacements per force at mass 1, by solving two equations at each frequency."""
    found = []
    for w in omega:
        first, second = k[0] + 1j * w * c[0], k[1] * (1 + 1j * loss) + 1j * w * c[1]
        Z = np.array([[first + second - m[0] * w**2, -second], [-second, second - m[1] * w**2]])
        if absorber is not None:
            mass, stiffness, damping = absorber
            z = stiffness + 1j * w * damping
            Z[0, 0] += -mass * w**2 * z / (z - mass * w**2)
        found.append(np.linalg.solve(Z, [1.0, 0.0]))
    return np.array(found).T[:, None]


def measured(response, omega=OMEGA, seed=0, noise=0.01, known=True, **options):
    rng = np.random.default_rng(seed)
    std = noise * (np.abs(response) + 0.05 * np.abs(response).mean())
    points = response + std * (rng.standard_normal(std.shape) + 1j * rng.standard_normal(std.shape))
    return rco.FrequencyResponse(points, omega, std=std if known else None, **LABELS, **options)


HIDDEN = {
    "stiffness at link2": {"k": (120.0, 75.0)},
    "damping at link1": {"c": (1.2, 0.3)},
    "mass at mass2": {"m": (1.0, 0.65)},
    "hidden_mode at mass1": {"absorber": (0.05, 0.05 * 12.0**2, 0.05)},
}


@pytest.mark.parametrize(("label", "known"), [*((label, True) for label in HIDDEN), ("mass at mass2", False)])
def test_hidden_effect_is_found(label, known):
    found = rco.diagnose(model(), measured(receptance(**HIDDEN[label]), known=known))
    assert found.verdict == "effect"
    assert found.best.effect.label == label
    assert ("No noise is given" in str(found)) is not known


def test_delay_and_gain_are_found():
    late = rco.diagnose(model(), measured(receptance() * np.exp(-1j * OMEGA * 0.004)))
    assert late.best.effect.label == "input_delay at force"
    assert abs(late.best.coefficients["delay"] - 0.004) < 4 * late.best.std["delay"]
    better = late.refine()
    assert rco.compare(better, measured(receptance() * np.exp(-1j * OMEGA * 0.004))).over_noise.max() < 1.15
    loud = rco.diagnose(model(), measured(1.07 * receptance()))
    assert "input_gain at force" in [effect.label for effect in loud.ambiguous]


@pytest.mark.parametrize("seed", [0, *slow(1, 2, 3)])
def test_nothing_missing(seed):
    assert rco.diagnose(model(), measured(receptance(), seed=seed)).verdict == "adequate"


def test_numbers_off():
    off = receptance(m=(1.015, 0.59), c=(0.52, 0.29), k=(118.0, 92.0))
    found = rco.diagnose(model(), measured(off))
    assert found.verdict == "parameters"
    truth = {"m1": 1.015, "m2": 0.59, "c1": 0.52, "c2": 0.29, "k1": 118.0, "k2": 92.0}
    for row in found.parameters:
        assert abs(row.value - truth[row.name]) < 4 * row.std


def test_material_damping_is_not_called_viscous():
    found = rco.diagnose(model(), measured(receptance(loss=0.06)))
    assert (found.verdict, found.none_of_these, found.places) == ("unexplained", 1.0, {})
    found.plot()


def test_error_bars_hold():
    """The estimate of 40 noises scatters as it says: chi-squared of 40 within its 0.1 % tails."""
    spring = effect("stiffness", "link2")
    z = []
    for seed in range(40):
        (row,) = rco.refine(model(), measured(receptance(k=(120.0, 80.0)), seed=seed), [spring]).parameters
        z.append((row.value - 80.0) / row.std)
    assert 16.9 < np.sum(np.square(z)) < 76.1


def test_half_a_spring_is_found_from_afar():
    """A peak that moved by many widths has no slope: the logarithms lead there."""
    spring = effect("stiffness", "link2")
    (row,) = rco.refine(model(), measured(receptance(k=(120.0, 30.0))), [spring]).parameters
    assert abs(row.value - 30.0) < 5 * row.std


def test_sampled_responses_know_the_hold():
    """Points of a held, sampled system: those of control.sample, refined to the continuous spring."""
    dt = 0.03
    omega = np.linspace(1.0, 0.9 * np.pi / dt, 200)
    true = rco.mass_spring_damper(M, C, (120.0, 80.0), sensors="displacement").system.sample(dt)
    points = np.moveaxis([true(np.exp(1j * w * dt)) for w in omega], 0, -1)
    data = measured(points, omega, dt=dt)
    (row,) = rco.refine(model(), data, [effect("stiffness", "link2")]).parameters
    assert abs(row.value - 80.0) < 4 * row.std


@pytest.mark.parametrize("hold", ["zoh", "foh", "bandlimited"])
def test_derivatives_are_those_of_differences(hold):
    from inner import ResponseEngine, Structure

    from rcorefine.data.response_record import ResponseRecord

    kinds = ("stiffness", "link2"), ("mass", "mass2"), ("input_delay", "force"), ("input_lag", "force")
    structure = Structure(model(), [effect(*kind) for kind in kinds])
    data = measured(receptance(), dt=0.04 if hold != "bandlimited" else 0.0, hold=hold)
    engine = ResponseEngine(structure, ResponseRecord.plain(data, structure.linear_model))
    theta = np.array([-10.0, 0.05, 0.003, 0.02])
    _, slopes = engine.response(theta)
    for k, slope in enumerate(slopes):
        step = np.zeros(4)
        step[k] = 1e-5 * max(abs(theta[k]), 1e-2)
        ahead, behind = (engine.response(theta + s * step, derivatives=False)[0] for s in (1, -1))
        scale = np.abs(slope).max()
        np.testing.assert_allclose((ahead - behind) / (2 * step[k]), slope, atol=1e-5 * scale)


def test_improve_adds_what_is_missing_and_judges_by_other_frequencies():
    laws = rco.effect_library(model(), kinds=["stiffness", "damping"])
    ladder = rco.improve(model(), measured(receptance(k=(120.0, 80.0))), candidates=laws)
    assert [step.name for step in ladder.steps[1:]] == ["add stiffness at link2"]
    assert ladder.verdict == "adequate"
    assert ladder.steps[-1].validation_rmse.max() < 1.3
    assert ladder.output_units == ("std", "std")


def test_compare_takes_one_or_several(tmp_path):
    data = measured(receptance(k=(120.0, 80.0)))
    better = rco.refine(model(), data, [effect("stiffness", "link2")])
    one = rco.compare([model(), better], data)
    assert one.over_noise[0].min() > 3
    assert one.over_noise[1].max() < 1.15
    several = rco.compare(better, [data, data.frd])
    assert several.fit.shape == (2, 2, 1)
    assert "over std" in str(several)
    assert several.plot().axes.shape == (4, 1)
    better.report(tmp_path / "better.html", data=data)
    rco.diagnose(model(), data).report(tmp_path / "found.html")


def test_a_response_of_a_record_counts_every_third_line():
    """Neighbors under a window err alike: with all of them the truth would be called wrong."""
    wrong = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        w = rng.standard_normal(6000)
        blank = rco.Measurement(
            w, np.zeros((2, 6000)), dt=0.05, output_labels=["q1", "q2"], input_labels="force"
        )
        y = rco.simulate(model(), blank, "zero").outputs
        noisy = y + 0.02 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
        record = rco.Measurement(w, noisy, dt=0.05, output_labels=["q1", "q2"], input_labels="force")
        found = rco.diagnose(model(), record.frequency_response(segment_length=1024))
        wrong += found.verdict != "adequate"
    assert wrong <= 1


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda d: rco.diagnose(model(), d, horizon=3.0), "horizon belongs to records in time"),
        (lambda d: rco.diagnose(model(), d, noise=0.1), "std"),
        (lambda d: rco.refine(model(), d, x0="zero"), "x0 belongs to records in time"),
        (lambda d: rco.compare(model(), d, horizon=2.0), "horizon belongs to records in time"),
        (lambda d: rco.refine(model(), [d, rco.Measurement([0, 1.0], [0, 1.0], dt=1)]), "Measurement among"),
        (lambda d: rco.diagnose(model(), d, candidates=[effect("cubic_stiffness", "link1")]), "amplitude"),
        (lambda d: rco.diagnose(model(), d, candidates=[effect("constant_force", "mass1")]), "not seen"),
        (lambda d: rco.refine(model(), d, [effect("coulomb_friction", "link1")]), "amplitude"),
        (lambda d: rco.refine(model(), first_of(d)), "lacks q2"),
        (lambda d: rco.localize_damage(model(), d), "record in time"),
        (lambda d: rco.diagnose(model(), d).suggest_experiment(), "records in time"),
        (lambda d: rco.improve(model(), few()), "too short to be split"),
        (lambda d: rco.diagnose(model(), few()), "too short to test"),
    ],
)  # fmt: skip
def test_what_has_no_meaning_is_refused_with_what_to_do(call, said):
    with pytest.raises((ValueError, ct.ControlArgument, ct.ControlDimension), match=said):
        call(measured(receptance()))


def first_of(data):
    return rco.FrequencyResponse(data.response[:1], data.omega, input_labels="force", output_labels="q1")


def few():
    omega = np.linspace(5.0, 10.0, 12)
    return measured(receptance(omega), omega)


LAWS = {
    "cubic_stiffness": ("link1", [400.0], 1e-5),
    "quadratic_damping": ("link1", [2.0], 1e-3),
    "clearance": ("link1", [60.0, 0.05], 2e-2),
    "input_deadzone": ("force", [0.3], 2e-3),
    "output_saturation": ("q1", [0.08], 1e-2),
    "coulomb_friction": ("link1", [0.3], 2e-2),
}


@pytest.mark.parametrize("kind", LAWS)
def test_answers_of_all_lines_are_those_of_one_sine_at_a_time(kind):
    from inner import ResponseEngine, Structure

    from rcorefine.data.response_record import ResponseRecord
    from rcorefine.engine.harmonic_balance import SineBalance

    one = rco.mass_spring_damper(1.0, 0.4, 100.0, sensors="displacement", outputs="q1")
    place, theta, close = LAWS[kind]
    structure = Structure(one, [effect(kind, place)], constants={0: 1e-4})
    omega, theta = np.linspace(5.0, 16.0, 12), np.array(theta)
    balance = SineBalance(structure, theta, 0, 15)
    slow = np.array([balance.solve(w, 2.0, []).outputs[0, 1] / 2.0 for w in omega])
    data = rco.FrequencyResponse(slow, omega, amplitude=2.0, input_labels="force", output_labels="q1")
    engine = ResponseEngine(structure, ResponseRecord.plain(data, one.linear))
    points, slopes = engine.response(theta)
    np.testing.assert_allclose(points[0, 0], slow, rtol=close)
    step = 1e-4 * theta[0] * np.eye(theta.size)[0]
    ahead, behind = (engine.response(theta + s * step, derivatives=False)[0] for s in (1, -1))
    np.testing.assert_allclose(
        slopes[0], (ahead - behind) / (2 * step[0]), atol=0.02 * np.abs(slopes[0]).max()
    )


def test_a_constant_force_shifts_the_answers_of_all_lines():
    """On a hardening spring it stiffens: as balanced one by one, and unlike without it."""
    from inner import ResponseEngine, Structure

    from rcorefine.data.response_record import ResponseRecord
    from rcorefine.engine.harmonic_balance import SineBalance

    one = rco.mass_spring_damper(1.0, 0.4, 100.0, sensors="displacement", outputs="q1")
    effects = [effect("cubic_stiffness", "link1"), effect("constant_force", "mass1")]
    structure, omega = Structure(one, effects), np.linspace(5.0, 16.0, 8)
    found = {}
    for force in (0.0, 20.0):
        theta = np.array([400.0, force])
        balance = SineBalance(structure, theta, 0, 15)
        slow = np.array([balance.solve(w, 0.5, []).outputs[0, 1] / 0.5 for w in omega])
        data = rco.FrequencyResponse(slow, omega, amplitude=0.5, input_labels="force", output_labels="q1")
        engine = ResponseEngine(structure, ResponseRecord.plain(data, one.linear))
        found[force] = engine.response(theta, derivatives=False)[0][0, 0]
        np.testing.assert_allclose(found[force], slow, rtol=1e-5)
    assert np.abs(found[20.0] - found[0.0]).max() > 0.1 * np.abs(found[0.0]).max()


def dwell(peaks, omega, force, steps=120, periods=50):
    """Fundamental over the sine of a mass (1 kg, 0.6 N s/m, 100 N/m) by Runge and Kutta, (levels, lines)."""
    w, peak = np.tile(omega, len(peaks)), np.repeat(peaks, omega.size)
    h, d, v, found = 2 * np.pi / w / steps, np.zeros(w.size), np.zeros(w.size), np.zeros(w.size, complex)

    def rate(t, d, v):
        return peak * np.cos(w * t) - 0.6 * v - 100.0 * d - force(d, v)

    for k in range(steps * periods):
        t = k * h
        if k >= steps * (periods - 2):
            found += d * np.exp(-1j * w * t) / steps / peak
        a1 = rate(t, d, v)
        a2 = rate(t + h / 2, d + h / 2 * v, v + h / 2 * a1)
        a3 = rate(t + h / 2, d + h / 2 * v + h * h / 4 * a1, v + h / 2 * a2)
        a4 = rate(t + h, d + h * v + h * h / 2 * a2, v + h * a3)
        d, v = d + h * v + h * h / 6 * (a1 + a2 + a3), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return found.reshape(len(peaks), -1)


def driven(force, peaks=(0.5, 2.0, 4.0), seed=0):
    rng, omega, data = np.random.default_rng(seed), np.linspace(5.0, 17.0, 40), []
    for peak, points in zip(peaks, dwell(peaks, omega, force), strict=True):
        std = 0.01 * np.abs(points)
        noisy = points + std * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
        names = {"input_labels": "force", "output_labels": "q1"}
        data.append(rco.FrequencyResponse(noisy, omega, std=std, amplitude=peak, **names))
    return rco.mass_spring_damper(1.0, 0.6, 100.0, sensors="displacement", outputs="q1"), data


def test_hardening_is_found_from_several_levels():
    one, data = driven(lambda d, v: 300.0 * d**3)
    kinds = ["stiffness", "damping", "cubic_stiffness", "quadratic_damping", "clearance", "coulomb_friction"]
    found = rco.diagnose(one, data, candidates=rco.effect_library(one, kinds=kinds))
    assert found.verdict == "effect"
    assert found.best.effect.label == "cubic_stiffness at link1"
    assert abs(found.best.coefficients["cubic_stiffness"] - 300.0) < 4 * found.best.std["cubic_stiffness"]
    assert rco.compare(found.refine(), data).levels[2].over_noise.max() < 1.25
    assert len(found.records) == 3


def balanced(peaks, omega, cubic):
    """Fundamental over the sine of d'' + 0.4 d' + 100 d + cubic d^3 = peak cos, odd harmonics to the 9th."""
    order, turn = np.arange(1, 10, 2), 2 * np.pi * np.arange(64) / 64
    waves, found = np.exp(1j * np.outer(turn, order)), np.zeros((len(peaks), omega.size), complex)

    def mismatch(z, peak, w):
        x = z[:5] + 1j * z[5:]
        force = cubic * (waves @ x).real ** 3 @ waves.conj() / 32
        left = (100.0 - (order * w) ** 2 + 0.4j * order * w) * x + force - peak * (order == 1)
        return np.concatenate([left.real, left.imag])

    for i, peak in enumerate(peaks):
        z = np.zeros(10)
        for k, w in enumerate(omega):
            tried = [root(mismatch, start, args=(peak, w), tol=1e-13).x for start in (z, np.zeros(10))]
            left = [np.abs(mismatch(each, peak, w)).max() for each in tried]
            z = tried[0] if left[0] < 1e-11 else tried[1]  # beyond its end the branch is left
            assert min(left) < 1e-11
            found[i, k] = (z[0] + 1j * z[5]) / peak
    return found


@pytest.mark.parametrize(("cubic", "lines", "std"), [(60.0, 201, None), (300.0, 61, 1e-9)])
def test_exact_responses_at_two_levels_are_explained(cubic, lines, std):
    """What is left of them is no noise but the error of solving for the response; no test may judge it."""
    omega, names = np.linspace(6.0, 16.0, lines), {"input_labels": "force", "output_labels": "q1"}
    data = [
        rco.FrequencyResponse(
            points[None, None],
            omega,
            std=None if std is None else std * np.abs(points)[None, None],
            amplitude=peak,
            **names,
        )
        for peak, points in zip((0.5, 2.0), balanced((0.5, 2.0), omega, cubic), strict=True)
    ]
    one = rco.mass_spring_damper(1.0, 0.4, 100.0, sensors="displacement", outputs="q1")
    laws = rco.effect_library(one, kinds=["stiffness", "damping", "cubic_stiffness", "clearance"])
    found = rco.diagnose(one, data, candidates=laws)
    assert found.effects == (rco.Effect("cubic_stiffness", "link1"),)
    assert "cubic_stiffness at link1" in [each.label for each in found.ambiguous]
    assert found.best.coefficients["cubic_stiffness"] == pytest.approx(cubic, rel=1e-5)


def test_quadratic_damping_is_not_excluded_by_the_law_that_contains_it():
    one, data = driven(lambda d, v: 0.5 * v * np.abs(v), seed=1)
    kinds = ["stiffness", "damping", "quadratic_damping", "power_damping", "cubic_stiffness"]
    found = rco.diagnose(one, data, candidates=rco.effect_library(one, kinds=kinds))
    assert "quadratic_damping at link1" in [each.label for each in found.ambiguous]


def test_laws_with_memory_are_refused():
    one, data = driven(lambda d, v: 0.0 * d, peaks=(1.0,))
    with pytest.raises(rco.ModelError, match="memory"):
        rco.diagnose(one, data, candidates=[effect("hysteresis", "link1")])
    with pytest.raises(rco.ModelError, match="memory"):
        rco.refine(one, data, [effect("hysteresis", "link1")])
