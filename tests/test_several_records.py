"""Several records: one joint least squares, other lengths, rates, holds and amplitudes; and `confirm`."""

from __future__ import annotations

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest
from cases import slow
from hidden.generator import Law, _with, held_motion, hidden_record, linear_states
from inner import fitted_from, levels, ordered_record
from scipy import stats
from scipy.optimize import least_squares
from scipy.signal import StateSpace, dlsim, lsim

import rcorefine as rco
from rcorefine.diagnosis.diagnose import amplitude_test
from rcorefine.inference.problem import Evaluation

M, C, K = 1.0, 0.4, 100.0
SPRING = rco.Effect("stiffness", "link1")


def model(sensors="displacement"):
    return rco.mass_spring_damper([M], [C], [K], sensors=sensors)


def oscillator(k, w, dt, hold, x0=(0.0, 0.0)):
    """Displacement of a mass on a spring, exactly, by scipy."""
    plant = StateSpace([[0, 1], [-k / M, -C / M]], [[0], [1 / M]], [[1, 0]], [[0]])
    t = np.arange(w.size) * dt
    if hold == "foh":
        return lsim(plant, w, t, X0=x0)[1]
    return dlsim(plant.to_discrete(dt, "zoh"), w, x0=x0)[1][:, 0]


def record(rng, n, dt=0.02, hold="zoh", amplitude=10.0, noise=0.01, k=90.0, x0=(0.0, 0.0), name=None):
    w = amplitude * rng.standard_normal(n)
    y = oscillator(k, w, dt, hold, x0)
    return rco.Measurement(w, y + noise * rng.standard_normal(n), dt=dt, hold=hold, name=name)


def mixed(rng):
    return [
        record(rng, 900),
        record(rng, 400, dt=0.035, hold="foh", amplitude=25.0, x0=(0.2, -1.0)),
        record(rng, 450, dt=0.01, amplitude=4.0),
    ]


def test_normal_equations_by_records_are_those_of_all_rows():
    rng = np.random.default_rng(5)
    blocks = [rng.standard_normal((n, 3)) * [1.0, 1e6, 1e-6] for n in (400, 2, 50, 60)]
    blocks[2][:, 1] = 0.0  # not felt
    blocks[3][:, 2] = blocks[3][:, 0]  # not told apart
    columns = [np.array([0, 1 + 2 * i, 2 + 2 * i]) for i in range(4)]
    prior = rng.standard_normal((2, 9))
    residual = rng.standard_normal(sum(len(b) for b in blocks) + 2)
    whole = Evaluation(residual, blocks, columns, [None] * 4, prior, True)
    normal, slope = whole.normal()
    size = np.linalg.norm(whole.jacobian, axis=0)
    np.testing.assert_allclose(
        slope / size, whole.jacobian.T @ residual / size, atol=1e-12 * np.linalg.norm(residual)
    )
    np.testing.assert_allclose(
        normal / np.outer(size, size), whole.jacobian.T @ whole.jacobian / np.outer(size, size), atol=1e-12
    )
    own, rows = residual[:-2], whole.jacobian[:-2]
    np.testing.assert_allclose(
        whole.normal(own)[0] / np.outer(size, size), rows.T @ rows / np.outer(size, size), atol=1e-12
    )
    np.testing.assert_allclose(
        whole.normal(own)[1] / size, rows.T @ own / size, atol=1e-12 * np.linalg.norm(own)
    )


def test_list_is_one_joint_least_squares(rng):
    """Other lengths, rates, holds and starts: scipy's least squares over all residuals at once."""
    data = mixed(rng)
    found = rco.refine(model(), data, [SPRING], offset=False)

    def residual(point):
        parts = []
        for i, r in enumerate(data):
            x0 = point[1 + 2 * i : 3 + 2 * i]
            parts.append(oscillator(point[0], r.inputs[0], r.dt, r.hold, x0) - r.outputs[0])
        return np.concatenate(parts)

    answer = least_squares(residual, np.r_[95.0, np.zeros(6)], x_scale="jac", xtol=1e-12, ftol=1e-12)
    assert found.parameters[0].value == pytest.approx(answer.x[0], rel=1e-7)
    np.testing.assert_allclose(found.initial_states.ravel(), answer.x[1:], atol=1e-5)
    sigma2 = 2 * answer.cost / (answer.fun.size - answer.x.size)
    std = np.sqrt(sigma2 * np.linalg.inv(answer.jac.T @ answer.jac)[0, 0])
    assert found.parameters[0].std == pytest.approx(std, rel=0.1)


def test_order_of_the_records_does_not_matter(rng):
    data = mixed(rng)
    one, two = (rco.refine(model(), records, [SPRING]) for records in (data, data[::-1]))
    np.testing.assert_allclose(one.theta, two.theta, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_friction_does_not_depend_on_which_amplitude_comes_first(factor):
    """The smoothing of sign(v) must suit the quiet record wherever it stands in the list.

    With the same substeps the minima agree to 2e-4 standard deviations; substeps that are chosen may
    shift a coefficient by half of one, as `refine` has it, and the two orders may choose differently.
    """
    hidden = hidden_record(
        5, effect="coulomb_friction", plant="quarter car", loss=0.1, noise=0.01, samples=500
    )
    other = again(hidden, factor * hidden.data.inputs, 1)
    friction = rco.Effect("coulomb_friction", hidden.place)
    orders = [hidden.data, other], [other, hidden.data]
    for substeps, share in ((16, 0.01), (None, 0.5)):
        one, two = (
            rco.refine(hidden.plant.model, records, [friction], substeps=substeps).parameters[0]
            for records in orders
        )
        assert one.value == pytest.approx(two.value, abs=share * one.std)


def test_segments_of_one_record_are_the_record_with_a_state_of_its_own(rng):
    whole = record(rng, 900)
    parts = [*whole.split(1 / 3)]
    joined = rco.refine(model(), parts, [SPRING])
    alone = rco.refine(model(), whole, [SPRING])
    row = alone.parameters[0]
    assert joined.initial_states.shape == (2, 2)
    assert joined.parameters[0].value == pytest.approx(row.value, abs=row.std)


def test_diagnose_on_a_list(rng):
    laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping", "cubic_stiffness")]
    found = rco.diagnose(model(), mixed(rng), candidates=laws)
    assert found.verdict == "effect"
    assert found.best.effect == SPRING
    assert abs(found.best.coefficients["stiffness"] + 10.0) < 4 * found.best.std["stiffness"]
    assert any("they agree" in note for note in found.notes)


def test_improve_splits_every_record_in_three(rng):
    data = mixed(rng)
    laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping")]
    ladder = rco.improve(model(), data, candidates=laws)
    assert [step.effect for step in ladder.steps[1:]] == [SPRING]
    assert ladder.verdict == "adequate"
    last = ladder.steps[-1]
    assert last.refinement.initial_states.shape == (3, 2)
    # sensor noise 0.01 on each part of each record, 1050 fitted and 350 held-out samples
    for error, n in ((last.train_rmse, 1050), (last.validation_rmse, 350)):
        assert float(error[0]) == pytest.approx(0.01, abs=4 * 0.01 / np.sqrt(2 * n))


def test_record_with_an_output_missing_is_named(rng):
    both = rco.mass_spring_damper([M, M], [C, C], [K, K], sensors=[("velocity", 1), ("velocity", 2)])
    n = 300
    full = rco.Measurement(
        rng.standard_normal(n), rng.standard_normal((2, n)), dt=0.02,
        input_labels="force", output_labels=["v1", "v2"], name="full",
    )  # fmt: skip
    partial = rco.Measurement(
        full.inputs, full.outputs[:1], dt=0.02, input_labels="force", output_labels="v1", name="partial"
    )
    for function in (
        lambda: rco.refine(both, [full, partial], [rco.Effect("stiffness", "link1")]),
        lambda: rco.diagnose(both, [full, partial]),
        lambda: rco.improve(both, [full, partial]),
    ):
        with pytest.raises(ct.ControlDimension, match=r"'partial'.*missing: v2.*all records share"):
            function()


# ---------------------------------------------------------------------------------- confirm
def again(hidden, w, seed, plant=None):
    """The same plant and law under other inputs; the sensors' noise stays as it was."""
    plant = plant or hidden.plant
    place = next(p for p in plant.places if p.name == hidden.place)
    x0 = linear_states(hidden.plant, hidden.data.inputs)
    y = _with(plant, w, hidden.kind, place, hidden.strength, x0)
    quiet = _with(plant, hidden.data.inputs, hidden.kind, place, hidden.strength, x0)
    rng = np.random.default_rng([seed, 9])
    noisy = y + hidden.noise * quiet.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    return rco.Measurement(w, noisy, dt=plant.dt, hold="foh")


@pytest.fixture(scope="module")
def mimic():
    """A clearance that one record lets pass as another law (benchmarks/experiments.py finds such)."""
    hidden = hidden_record(2003, plant="ring", effect="clearance", loss=0.03, noise=0.03)
    found = rco.diagnose(hidden.plant.model, hidden.data, candidates=hidden.candidates)
    assert found.effects == (rco.Effect("cubic_stiffness", hidden.place),)  # and a clearance is hidden
    records = [hidden.data, again(hidden, 2 * hidden.data.inputs, 3)]
    seen = rco.confirm(
        found.best.refinement, records, candidates=hidden.candidates, force_ratio=found.force_ratio
    )
    return hidden, records, seen


def test_impostor_is_refuted_by_a_second_amplitude(mimic):
    hidden, records, seen = mimic
    assert seen.verdict == "refuted"
    assert seen.p_value < 1e-6
    assert "needs" in seen.message
    assert rco.diagnose(hidden.plant.model, records, candidates=hidden.candidates).verdict == "unexplained"


def test_words_and_picture_of_a_confirmation(mimic):
    *_, seen = mimic
    assert max(map(len, str(seen).splitlines())) <= 80
    assert "refuted" in seen._repr_html_()
    plot = seen.plot(title="<two>", label="alone", show_legend=True)
    assert plot.axes.shape == (1, len(seen.names))
    with pytest.raises(ct.ControlDimension, match="coefficients"):
        seen.plot(ax=plt.subplots(1, len(seen.names) + 1)[1])


def test_true_law_is_confirmed_and_alike_amplitudes_are_said(rng):
    records = [record(rng, 600), record(rng, 600, amplitude=20.0)]
    spring = rco.refine(model(), records[0], [SPRING])
    seen = rco.confirm(spring, records)
    assert seen.verdict == "confirmed"
    assert "similar" not in seen.message
    assert seen.estimates[1].level == pytest.approx(2.0, rel=0.15)
    assert abs(seen.estimates[1].coefficients[0] + 10) < 4 * seen.estimates[1].std[0]
    same = rco.confirm(spring, [records[0], record(rng, 600)])
    assert "similar" in same.message


@pytest.mark.parametrize("count", [8, *slow(25)])
def test_agreement_is_uniform_where_the_law_is_true(rng, count):
    """Wald p-values over pairs of records, by Kolmogorov and Smirnov's test at 0.1 %, exact for any count."""
    values = []
    for _ in range(count):
        records = [record(rng, 300), record(rng, 300, amplitude=20.0)]
        seen = rco.confirm(rco.refine(model(), records[0], [SPRING]), records, candidates=[])
        values.append(seen.estimates[1].agreement)
    assert stats.kstest(values, "uniform").pvalue > 1e-3


def test_what_confirm_refuses(rng):
    data = record(rng, 300)
    spring = rco.refine(model(), data, [SPRING])
    with pytest.raises(ct.ControlArgument, match="one record"):
        rco.confirm(spring, [data])
    with pytest.raises(ct.ControlArgument, match="call refine first"):
        rco.confirm(model(), [data, data])
    with pytest.raises(ct.ControlArgument, match="significance"):
        rco.confirm(spring, [data, data], significance=0.0)


def test_an_unmeasured_force_does_not_refute_a_true_law(rng):
    """Force noise at the mass, 5 % of the measured force in the first record, and as large in the second."""
    records = []
    for amplitude in (10.0, 20.0):
        w = amplitude * rng.standard_normal(1500)
        y = oscillator(90.0, w + 0.5 * rng.standard_normal(w.size), 0.02, "zoh")
        records.append(rco.Measurement(w, y + 1e-3 * rng.standard_normal(w.size), dt=0.02))
    spring = rco.refine(model(), records[0], [SPRING])
    seen = rco.confirm(spring, records, force_ratio=0.05)
    assert seen.verdict == "confirmed"
    assert abs(seen.estimates[1].coefficients[0] + 10) < 4 * seen.estimates[1].std[0]
    with pytest.raises(ct.ControlArgument, match="negative"):
        rco.confirm(spring, records, force_ratio=-1.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["clearance", "jenkins"])
def test_impostors_are_refuted_and_true_laws_kept(kind):
    """Refuted in >= 90 % of what passes, true laws kept in >= 95 %; bounds at 0.1 %."""
    passed = refuted = true = kept = 0
    for seed in range(12000, 12024):
        try:
            hidden = hidden_record(seed, plant="quarter car", effect=kind, loss=0.03, noise=0.03)
            found = rco.diagnose(hidden.plant.model, hidden.data, candidates=hidden.candidates)
            if found.verdict in ("effect", "ambiguous"):
                seen = rco.confirm(
                    found.best.refinement,
                    [hidden.data, again(hidden, 2 * hidden.data.inputs, seed)],
                    candidates=hidden.candidates,
                )
                passed += 1
                refuted += seen.verdict == "refuted"
            hidden = hidden_record(seed, plant="chain", loss=0.05, noise=0.03)
            law = rco.refine(hidden.plant.model, hidden.data, [rco.Effect(hidden.kind, hidden.place)])
            seen = rco.confirm(
                law,
                [hidden.data, again(hidden, 2 * hidden.data.inputs, seed)],
                candidates=hidden.candidates,
            )
            true += 1
            kept += seen.verdict == "confirmed"
        except FloatingPointError:
            continue
    assert refuted >= stats.binom.ppf(1e-3, passed, 0.9)
    assert kept >= stats.binom.ppf(1e-3, true, 0.95)


#: Noise in proportion to the signal is likeliest there, and weighted so the residual shows the 0.2 %.
HARDLY_OFF = pytest.mark.xfail(reason="weighted residuals show a drag that differs by 0.2 %")


@pytest.mark.parametrize(
    ("warmer", "word"), [pytest.param(1.002, "effect", marks=HARDLY_OFF), (1.1, "unexplained")]
)
def test_amplitudes_that_differ_by_less_than_a_percent_take_no_name(warmer, word, rng):
    """Errors of 0.02 % tell 0.2 % apart, which warmth or a kink within a step makes: no other law."""
    A, B = np.array([[0.0, 1.0], [-K / M, -C / M]]), np.array([0.0, 1.0 / M])
    data = []
    for amplitude, c in ((4.0, 2.0), (12.0, 2.0 * warmer)):
        w = amplitude * np.repeat(rng.uniform(-1, 1, 40), 15)
        drag = Law("quadratic_damping", np.array([c, 0.0, 0.0]))
        y = held_motion(A, np.outer(w, B), 0.02, [(drag, [0.0, -1.0 / M], [1.0, 0.0], [0.0, 1.0])])[:, 0]
        data.append(rco.Measurement(w, y + 0.001 * y.std() * rng.standard_normal(y.size), dt=0.02))
    laws = rco.effect_library(model(), kinds=["stiffness", "damping", "quadratic_damping"])
    found = rco.diagnose(model(), data, candidates=laws)
    assert found.verdict == word
    if word == "effect":
        assert found.best.effect == rco.Effect("quadratic_damping", "link1")
        assert found.best.probability > 0.5 > found.none_of_these


@pytest.mark.parametrize(("stiffness", "verdict"), [(100.0, "confirmed"), (115.0, "refuted")])
def test_a_model_without_an_effect_is_confirmed_or_refuted(stiffness, verdict, rng):
    """Where nothing was kept, the residual of the model itself is tested."""
    model = rco.mass_spring_damper(1.0, 0.8, 100.0)
    records = []
    for k in (100.0, stiffness):
        force = 10.0 * rng.standard_normal(1000)
        silent = rco.Measurement(force, np.zeros(1000), dt=0.02)
        y = rco.simulate(rco.mass_spring_damper(1.0, 0.8, k), silent, "zero").outputs[0]
        records.append(rco.Measurement(force, y + 0.01 * y.std() * rng.standard_normal(1000), dt=0.02))
    found = rco.confirm(rco.refine(model, records[0], []), records)
    assert (found.verdict, found.names) == (verdict, ())
    assert [one.agreement for one in found.estimates] == [1.0, 1.0]
    assert "model without an added effect" in str(found)
    with pytest.raises(rco.ModelError, match="no coefficient to plot"):
        found.plot()


def steps_of_two_sizes(law, seed=1, n=3000):
    """A mass pushed and then pushed twice as strongly, by Runge and Kutta; noise of 1 %."""
    rng, dt, x, y = np.random.default_rng(seed), 0.02, np.zeros(2), np.zeros(n)
    push = rng.standard_normal(n) * np.where(np.arange(n) < n // 2, 12.0, 24.0)

    def rate(x, u):
        return np.array([x[1], u - 0.4 * x[1] - law(x[0])])

    for k in range(n - 1):
        for _ in range(4):
            h, u = dt / 4, push[k]
            a = rate(x, u)
            b = rate(x + h / 2 * a, u)
            c = rate(x + h / 2 * b, u)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, u))
        y[k + 1] = x[0]
    return rco.Measurement(push, y + 0.01 * y.std() * rng.standard_normal(n), dt=dt, hold="zoh")


@pytest.mark.parametrize(("power", "size", "agrees"), [(3, 60, True), (5, 60, False)])
def test_stretches_of_one_record_have_to_agree_on_a_law(power, size, agrees):
    """A cubic spring has one coefficient at both sizes; fitted to a quintic one it has two."""
    data = steps_of_two_sizes(lambda d: 100 * d + size * d**power)
    model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    held = rco.refine(model, data, [rco.Effect("cubic_stiffness", "link1")], offset=False)
    fitted = fitted_from(held, [ordered_record(held.physical_model, data)], tolerance=0.0, noise=None)
    p_value, sentence = amplitude_test(fitted, 1, levels())
    assert (p_value > levels().disagree) == agrees
    assert ("they agree" in sentence) == agrees
