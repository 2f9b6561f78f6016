"""Units of inputs and outputs change no answer: the same record in other units, and the model with it."""

import control as ct
import numpy as np
import pytest
from cases import slow
from scipy.linalg import expm
from scipy.signal import lfilter

import rcorefine as rco

SCALES = [(1e-15, 1.0), (1e15, 1.0), (1.0, 1e-15), (1.0, 1e15), (1e-9, 1e-9)]
EXACT = [(2.0**-45, 1.0), (1.0, 2.0**40), (2.0**30, 2.0**-30)]  # these round nothing
M, K, D = (
    np.diag([0.8, 1.1]),
    np.array([[260.0, -140.0], [-140.0, 140.0]]),
    np.array([[0.9, -0.4], [-0.4, 0.4]]),
)
DT = 0.03


def rates(stiffness, damping=D):
    inverse = np.linalg.inv(M)
    return np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ stiffness, -inverse @ damping]])


def signals(n=700, change=0, friction=0.0, level=0.02):
    """Input and output of n samples; from sample `change` on 12 % of the inner spring are lost."""
    rng = np.random.default_rng(17)
    w = lfilter([1.0], [1.0, -0.6], rng.standard_normal(n))
    lost = 0.12 * 140.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    x, y = np.zeros(4), np.zeros(n)
    pieces = 30
    steps = []
    for A in (rates(K), rates(K - lost)):
        block = np.zeros((6, 6))
        block[:4, :4], block[3, 4] = A, 1 / 1.1
        block[2, 5], block[3, 5] = 1 / 0.8, -1 / 1.1
        whole = expm(block * DT / pieces)
        steps.append((whole[:4, :4], whole[:4, 4], whole[:4, 5]))
    for i in range(n):
        y[i] = x[2]
        Phi, G, F = steps[int(0 < change <= i)]
        for _ in range(pieces):
            x = Phi @ x + G * w[i] + F * friction * np.tanh((x[3] - x[2]) / 1e-3)
    return w, y + level * y.std() * rng.standard_normal(n)


def in_units(of_inputs, of_outputs):
    """The model for inputs and outputs in other units; a force at a port is then one of the input's."""
    B, C = np.zeros((4, 1)), np.zeros((1, 4))
    B[3], C[0, 2] = 1 / 1.1 / of_inputs, of_outputs
    return ct.ss(rates(K), B, C, [[0.0]], inputs="w", outputs="y", states=["q1", "q2", "v1", "v2"])


def record(pair, of_inputs, of_outputs):
    return rco.Measurement(pair[0] * of_inputs, pair[1] * of_outputs, dt=DT)


def refined(of_inputs, of_outputs, pair):
    friction = rco.Effect("coulomb_friction", "q1-q2")
    answer = rco.refine(
        in_units(of_inputs, of_outputs), record(pair, of_inputs, of_outputs), [friction], free="linear"
    )
    units = {"w": 1.0, "y": of_outputs}  # the gain of the input has none
    figures = [(row.value, row.std) for row in answer.parameters]
    by = [units.get(row.place, of_inputs) for row in answer.parameters]
    return (
        answer.success,
        np.array(figures) / np.array(by)[:, None],
        np.r_[answer.fit, answer.rmse / of_outputs],
    )


def localized(of_inputs, of_outputs, pair):
    answer = rco.localize_damage(in_units(of_inputs, of_outputs), record(pair, of_inputs, of_outputs))
    figures = [(row.percent, row.percent_std, row.limit_percent) for row in answer.rows]
    return (answer.explained, [row.label for row in answer.named]), np.array(figures), answer.fit


def watched(of_inputs, of_outputs, pair):
    kinds = ("stiffness", "damping", "clearance", "coulomb_friction")
    candidates = [rco.Effect(kind, place) for kind in kinds for place in ("q1", "q1-q2")]
    monitor = rco.Monitor(in_units(of_inputs, of_outputs), candidates, dt=DT, learn=400)
    monitor.run(record(pair, of_inputs, of_outputs))
    alarm = monitor.alarm
    value = np.array(list(alarm.coefficients.values())) / of_inputs
    return (alarm.effect.label, alarm.sample, alarm.since_sample), value, monitor.statistic


def compared(of_inputs, of_outputs, pair):
    answer = rco.compare(in_units(of_inputs, of_outputs), record(pair, of_inputs, of_outputs))
    return None, np.ravel(answer.fit), np.ravel(answer.rmse) / of_outputs


def streamed(of_inputs, of_outputs, pair):
    effects = [rco.Effect("stiffness", "q1-q2"), rco.Effect("damping", "q1-q2")]
    refiner = rco.RCORefiner(in_units(of_inputs, of_outputs), dt=DT, effects=effects)
    refiner.run(record(pair, of_inputs, of_outputs))
    figures = np.array([(row.value, row.std) for row in refiner.parameters]) / of_inputs
    return None, figures[:, 0], figures[:, 1]


def diagnosed(of_inputs, of_outputs, pair):
    kinds = ("coulomb_friction", "quadratic_damping", "stiffness", "hysteresis")
    candidates = [rco.Effect(kind, "q1-q2") for kind in kinds] + [rco.Effect("input_lag", "w")]
    answer = rco.diagnose(
        in_units(of_inputs, of_outputs), record(pair, of_inputs, of_outputs), candidates=candidates
    )
    words = answer.verdict, [row.effect.label for row in answer.ranking], answer.ambiguous
    best = answer.best
    figures = np.array([*best.coefficients.values(), *best.std.values()]) / of_inputs
    # p-values down to 1e-200: their digits are those of the exponent
    tests = np.log10([max(test.p_value, 1e-200) for test in answer.tests])
    return words, np.r_[figures, [row.probability for row in answer.ranking]], tests


def adequate(of_inputs, of_outputs, pair):
    answer = rco.diagnose(in_units(of_inputs, of_outputs), record(pair, of_inputs, of_outputs))
    return answer.verdict, np.array([test.p_value for test in answer.tests]), np.ones(1)


def improved(of_inputs, of_outputs, pair):
    kinds = ("coulomb_friction", "quadratic_damping", "stiffness")
    candidates = [rco.Effect(kind, "q1-q2") for kind in kinds]
    answer = rco.improve(
        in_units(of_inputs, of_outputs),
        record(pair, of_inputs, of_outputs),
        candidates=candidates,
        max_effects=2,
    )
    words = [(step.effect and step.effect.label, step.verdict) for step in answer.steps]
    errors = [[np.ravel(e)[0] for e in (step.train_rmse, step.validation_rmse)] for step in answer.steps]
    return words, np.array(errors) / of_outputs, np.ones(1)


#: With inputs in units of 1e-15 the width of friction ends elsewhere, a quarter of a standard deviation away.
UNSETTLED = pytest.mark.xfail(reason="the width of friction is chosen among a few")


@pytest.mark.parametrize(
    "task, hidden",
    [
        (compared, {"friction": 0.6}),
        (refined, {"friction": 0.6}),
        (localized, {"change": 1}),
        (watched, {"n": 1000, "change": 600}),
        (streamed, {"change": 1}),
        (adequate, {}),
        pytest.param(diagnosed, {"friction": 0.6}, marks=UNSETTLED),
        pytest.param(improved, {"friction": 0.6}, marks=pytest.mark.slow),
    ],
    ids=["compare", "refine", "localize_damage", "Monitor", "RCORefiner", "adequate", "diagnose", "improve"],
)
def test_answers_do_not_depend_on_units(task, hidden):
    pair = signals(**hidden)
    plain = task(1.0, 1.0, pair)
    for scales in EXACT:
        answer = task(*scales, pair)
        assert answer[0] == plain[0]
        for found, expected in zip(answer[1:], plain[1:], strict=True):
            assert np.allclose(found, expected, rtol=1e-9, atol=0)
    for scales in SCALES:
        answer = task(*scales, pair)
        assert answer[0] == plain[0]
        for found, expected in zip(answer[1:], plain[1:], strict=True):
            assert np.allclose(found, expected, rtol=2e-6, atol=1e-9), scales


def resonator(length, second, newton):
    """A spring that hardens by a tenth, about its resonance, also in units of micrometers."""
    rng = np.random.default_rng(3)
    n, dt, pieces, hard = 900, 0.5, 20, 0.04
    t = dt * np.arange(n)
    w = sum(0.04 * np.sin(f * t + rng.uniform(0, 2 * np.pi)) for f in np.linspace(0.7, 1.4, 12))
    block = np.zeros((4, 4))
    block[:2], block[0, 1] = [[0, 0, 0, 0], [-1.0, -0.02, 1.0, 1.0]], 1.0
    whole = expm(block * dt / pieces / 2)
    Phi, G, F = whole[:2, :2], whole[:2, 2], whole[:2, 3]
    x, y = np.zeros(2), np.zeros(n)
    for i in range(n):
        y[i] = x[0]
        for _ in range(pieces):  # the force from the middle of each step: second order
            middle = Phi @ x + G * w[i] - F * hard * x[0] ** 3
            whole_step = Phi @ (Phi @ x + G * w[i]) + G * w[i]
            x = whole_step - (Phi @ F + F) * hard * middle[0] ** 3
    y += 0.02 * y.std() * rng.standard_normal(n)
    model = ct.ss(
        [[0, 1], [-1 / second**2, -0.02 / second]], [[0], [length / second**2 / newton]], [[1.0, 0]], 0,
        states=["x", "v"], inputs="F", outputs="pos",
    )  # fmt: skip
    labels = {"input_labels": "F", "output_labels": "pos"}
    data = rco.Measurement(w * newton, y * length, dt=dt * second, **labels)
    kinds = ("stiffness", "cubic_stiffness", "quadratic_damping")
    found = rco.diagnose(model, data, candidates=[rco.Effect(kind, "x") for kind in kinds])
    return found, hard * newton / length**3


@pytest.mark.parametrize("units", [(1e-6, 1e-5, 1e-6), *slow(((1.0, 1.0, 1.0),))], ids=str)
def test_names_do_not_depend_on_units_of_length_time_and_force(units):
    """Beside offsets of micronewtons 1e12 N/m3 is no coefficient without effect."""
    found, hardening = resonator(*units)
    assert (found.verdict, found.best.effect.kind) == ("effect", "cubic_stiffness")
    row = found.best
    assert abs(row.coefficients["cubic_stiffness"] - hardening) < 4 * row.std["cubic_stiffness"]
    assert row.std["cubic_stiffness"] < 0.05 * hardening
