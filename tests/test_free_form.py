"""None of these: tables as laws, free curves and what they cost, and a diagnosis that finds no name."""

import functools
import pickle
import warnings

import control as ct
import numpy as np
import pytest
from cases import named
from inner import Engine, Structure, fitted_from, residual_tests, unit_forces
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import RegularGridInterpolator
from scipy.signal import cont2discrete, dlsim
from scipy.stats import multivariate_normal

import rcorefine as rco
from rcorefine.diagnosis import beside
from rcorefine.effects.given import share_beyond
from rcorefine.inference import free_form

SPRING = rco.Table(d=[-1.0, 0.0, 2.0], force=[-2.0, 0.0, 8.0])
BOTH = rco.Table(d=[-1.0, 0.0, 2.0], v=[-1.0, 1.0], force=[[0.0, 1.0], [2.0, 3.0], [4.0, 9.0]])


class TestTable:
    def test_agrees_with_scipy_inside_and_beyond(self):
        d, v = np.random.default_rng(0).uniform(-3, 4, (2, 200))
        oracle = RegularGridInterpolator(
            (BOTH.d, BOTH.v), np.array(BOTH.force), bounds_error=False, fill_value=None
        )
        assert BOTH(d, v) == pytest.approx(oracle(np.column_stack([d, v])), abs=1e-12)
        effect = rco.Effect("tabulated", "link1", law=BOTH)
        assert unit_forces(effect, d, v, [{}])[0] == pytest.approx(BOTH(d, v), abs=1e-12)

    def test_slopes_are_those_of_the_planes(self):
        law = rco.Effect("tabulated", "link1", law=SPRING).spec
        where = law.constants["table"]
        assert law.slopes(1.0, 5.0, 3.0, where) == pytest.approx((12.0, 12.0, 0.0, 4.0, 0.0))
        assert law.needs == {"position"}
        assert rco.Effect("tabulated", "link1", law=BOTH).spec.needs == {"position", "velocity"}

    def test_moves_a_model_as_the_law_of_the_same_curve(self):
        # max(d, 0) is a table of three knots
        kinked = rco.Table(d=[-1.0, 0.0, 1.0], force=[0.0, 0.0, 40.0])
        model = rco.mass_spring_damper(1.0, 0.5, 100.0)
        record = rco.Measurement(10 * np.random.default_rng(0).standard_normal(400), np.zeros(400), dt=0.02)
        runs = []
        for effect, value in (
            (rco.Effect("tabulated", "link1", law=kinked), 1.0),
            (rco.Effect("bilinear_stiffness", "link1"), 40.0),
        ):
            engine = Engine(Structure(model, [effect]), record, substeps=4)
            runs.append(engine.run(np.array([value])))
        assert runs[0].outputs == pytest.approx(runs[1].outputs, rel=1e-9)
        # per unit of its scale the table does 40 times as much
        assert runs[0].sensitivity[..., 0] == pytest.approx(
            40.0 * runs[1].sensitivity[..., 0], rel=1e-6, abs=1e-9
        )

    def test_is_a_value(self):
        effect = rco.Effect("tabulated", "link1", law=SPRING)
        again = pickle.loads(pickle.dumps(effect))
        assert again == effect
        assert hash(again) == hash(effect)
        assert again.law == SPRING
        assert effect != rco.Effect("tabulated", "link1", law=BOTH)
        assert eval(repr(SPRING), {"Table": rco.Table}) == SPRING

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"d": [0.0, 0.0], "force": [1.0, 2.0]}, "rising"),
            ({"d": [0.0, 1.0], "force": [1.0, 2.0, 3.0]}, "knots ask for"),
            ({"d": [0.0, np.nan], "force": [1.0, 2.0]}, "not finite"),
            ({"v": [0.0, 1.0], "force": [1.0, np.inf]}, "not finite"),
        ],
    )
    def test_says_what_is_wrong(self, given, message):
        with pytest.raises(rco.ModelError, match=message):
            rco.Table(**given)

    def test_an_effect_needs_it_and_cannot_move_it(self):
        with pytest.raises(ct.ControlArgument, match="needs law=, a Table"):
            rco.Effect("tabulated", "link1")
        with pytest.raises(ct.ControlArgument, match="no such coefficient"):
            rco.Effect("tabulated", "link1", law=SPRING, fixed={"table": 1.0})
        with pytest.raises(ct.ControlArgument, match="needs its law"):
            rco.effect_library(rco.mass_spring_damper(1.0, 0.5, 100.0), kinds=["tabulated"])


class TestCurve:
    def test_holds_what_it_promises(self):
        # f(d) + g(v) + v h(d), straight between the knots: the coefficients are values at the knots
        rng = np.random.default_rng(1)
        d, v = rng.standard_normal((2, 500))
        curve = free_form.Curve.along("link1", d, v)
        values = np.concatenate([np.abs(curve.d), 2.0 * curve.v, np.maximum(curve.d, 0.0) * curve.scale])
        knots = np.interp(d, curve.d, np.maximum(curve.d, 0.0))
        expected = np.interp(d, curve.d, np.abs(curve.d)) + 2.0 * v + v * knots
        assert curve.columns(d, v) @ values == pytest.approx(expected, abs=1e-12)
        assert curve.table(values)(d, v) == pytest.approx(expected, abs=1e-12)

    def test_one_signal_alone(self):
        v = np.random.default_rng(2).standard_normal(300)
        curve = free_form.Curve.along("tank1", np.zeros(300), v)
        assert curve.d.size == 0
        assert curve.table(curve.v)(0.0, 0.3) == pytest.approx(0.3)


def test_evidence_is_the_likelihood_of_a_normal_force():
    rng = np.random.default_rng(3)
    columns = rng.standard_normal((60, 4)) * [3.0, 1.0, 0.3, 0.1]
    residual = columns @ [0.5, -1.0, 0.0, 2.0] + rng.standard_normal(60)
    found = free_form.evidence(residual, columns)
    none = multivariate_normal.logpdf(residual, cov=np.eye(60))
    some = multivariate_normal.logpdf(residual, cov=np.eye(60) + found.variance * columns @ columns.T)
    assert found.gain == pytest.approx(some - none)
    for factor in (0.1, 10.0):  # the size is the likeliest
        other = np.eye(60) + factor * found.variance * columns @ columns.T
        assert multivariate_normal.logpdf(residual, cov=other) < some
    assert 0.0 < found.dof < 4.0


@pytest.mark.parametrize("there", [0.0, 0.3])
def test_the_odds_of_a_departure_are_likelihoods_averaged_over_its_size(there):
    rng = np.random.default_rng(4)
    columns = 3.0 * rng.standard_normal((50, 3))
    residual = there * columns @ [1.0, -1.0, 0.5] + rng.standard_normal(50)
    none = multivariate_normal.logpdf(residual, cov=np.eye(50))

    def odds(size):
        some = multivariate_normal.logpdf(residual, cov=np.eye(50) + size**2 * columns @ columns.T)
        return np.exp(some - none)

    expected = np.log(quad(odds, 0.0, 1.0, epsrel=1e-8)[0])
    assert free_form.averaged_evidence(residual, columns) == pytest.approx(expected, abs=1e-3)
    # what the record would not show stays as likely as the law, what it would show and does not is out
    assert free_form.averaged_evidence(residual, 1e-6 * columns) == pytest.approx(0.0, abs=1e-3)
    assert free_form.averaged_evidence(rng.standard_normal(50), 1e4 * columns) < -5.0


def test_a_stop_slips_at_its_radius_and_springs_back_from_there():
    up, back = np.linspace(0.0, 1.0, 101), np.linspace(1.0, 0.0, 101)[1:]
    found = beside.stops(np.concatenate([up, back]), 1.0, [0.3])[:, 0]
    wanted = np.concatenate([np.minimum(up, 0.3), np.maximum(0.3 - (1.0 - back), -0.3)])
    assert found == pytest.approx((wanted - wanted.mean()) / wanted.std(), abs=1e-9)


@pytest.mark.parametrize(("law", "passes"), [("hysteresis", True), ("coulomb_friction", False)])
def test_memory_tells_a_law_that_remembers_otherwise(law, passes):
    """Dahl's loop in the record: Coulomb's friction remembers nothing."""
    model = rco.mass_spring_damper(1.0, 0.6, 100.0)
    record = rco.Measurement(10 * np.random.default_rng(6).standard_normal(1500), np.zeros(1500), dt=0.02)
    hidden = Engine(Structure(model, [rco.Effect("hysteresis", "link1")]), record, substeps=8)
    y = hidden.run(np.array([1.0, 0.03])).outputs
    y = y + 0.02 * y.std() * np.random.default_rng(8).standard_normal(y.shape)
    record = rco.Measurement(record.inputs, y, dt=0.02, hold="zoh")
    better = rco.refine(model, record, [rco.Effect(law, "link1")])
    tested = residual_tests.TestedResidual(fitted_from(better, [record], tolerance=0.0))
    (memory,) = (test for test in beside.Beside(tested, "link1").tests() if test.name == "memory at link1")
    assert memory.p_value > 0.01 if passes else memory.p_value < 1e-4


# ------------------------------------------------------------------ a diagnosis without a name
@functools.cache
def sine_spring():
    """One mass, and a spring whose force is a sine of the displacement; two records."""
    model = rco.mass_spring_damper(1.0, 0.6, 100.0)
    dt, n = 0.02, 1000
    rng = np.random.default_rng(5)

    def truth(w):
        def rate(t, x):
            force = 4.0 * np.sin(x[0] / 0.12)
            return [x[1], w[min(int(t / dt + 1e-9), n - 1)] - 0.6 * x[1] - 100.0 * x[0] - force]

        x, out = [0.0, 0.0], []
        for k in range(n):
            out.append(x[0])
            x = solve_ivp(rate, (k * dt, (k + 1) * dt), x, rtol=1e-7, atol=1e-9, max_step=dt / 4).y[:, -1]
        return np.array(out)

    records = []
    for size in (18.0, 14.0):  # the second one stays where the first one was
        w = size * rng.standard_normal(n)
        y = truth(w)
        noise = 0.03 * y.std()
        records.append(rco.Measurement(w, y + noise * rng.standard_normal(n), dt=dt, hold="zoh"))
    kinds = ("stiffness", "damping", "cubic_stiffness", "coulomb_friction", "clearance")
    found = rco.diagnose(model, records[0], candidates=[rco.Effect(kind, "link1") for kind in kinds])
    return model, records, noise, found


def test_no_name_but_place_and_curve():
    model, records, noise, found = sine_spring()
    assert found.verdict == "unexplained"
    assert found.place == "link1"
    assert sum(found.places.values()) == pytest.approx(1.0, abs=1e-3)
    assert found.none_of_these == 1.0
    assert np.isnan([row.probability for row in found.ranking]).all()
    law = found.law()
    assert law.label == "unknown force, tabulated at link1"
    d = np.linspace(-0.2, 0.2, 41)
    assert law.law(d, 0.0) == pytest.approx(4.0 * np.sin(d / 0.12), abs=0.5)
    better = rco.refine(model, records[0], [law])
    assert better.parameters[0].value == pytest.approx(1.0, abs=0.05)
    assert rco.compare(better, records[1]).rmse[0] < 1.5 * noise
    shares = [share for _, share in found.open_law.nearest]
    assert shares == sorted(shares, reverse=True)
    assert 0.0 <= shares[0] <= 100.0


def test_where_nothing_passes_the_smallest_error_stands_first():
    _, records, _, found = sine_spring()
    fits = [row.fit_after for row in found.ranking]
    assert fits == sorted(fits, reverse=True)
    for row in found.ranking:  # least squares of the plain error: none does better
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # two offsets are hardly told apart
            alone = rco.refine(found.base, records[0], [row.effect])
        if any(one.role == "linear" for one in row.refinement.parameters):  # parameters re-estimated, too
            assert row.fit_after > alone.fit[0] - 0.3
        else:
            assert row.fit_after == pytest.approx(alone.fit[0], abs=0.3)


def test_what_lies_beyond_the_table_is_said():
    model, records, _, found = sine_spring()
    better = rco.refine(model, records[0], [found.law()])
    beyond = "leaves the table of unknown force, tabulated at link1"
    strong = rco.Measurement(3.0 * records[1].inputs, records[1].outputs, dt=0.02, hold="zoh")
    assert any(beyond in note for note in rco.compare(better, strong, x0="zero").notes)
    gentle = rco.Measurement(0.5 * records[1].inputs, records[1].outputs, dt=0.02, hold="zoh")
    assert not any(beyond in note for note in rco.compare(better, gentle, x0="zero").notes)
    assert share_beyond(BOTH, np.array([0.0, 3.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0, -1.5])) == 0.5
    assert share_beyond(SPRING, np.array([0.0, 3.0]), np.array([9.0, 9.0])) == 0.5


def test_words_and_pictures_give_no_probability_to_what_failed():
    *_, found = sine_spring()
    text = str(found)
    assert max(map(len, text.splitlines())) <= 80
    assert "unknown force, tabulated at link1" in text
    assert "at link1 (probability 1.00)" in " ".join(text.split())
    assert "nan" not in text
    assert "nan" not in found._repr_html_()
    assert str(pickle.loads(pickle.dumps(found))) == text


def test_report_shows_the_table_and_no_probability(tmp_path):
    *_, found = sine_spring()
    page = found.report(tmp_path / "open.html").read_text()
    assert "unknown force, tabulated at link1" in page
    assert ">nan<" not in page
    assert found.hidden_force.plot().axes.shape == (1, 3)


def test_improve_ends_with_the_table_where_nothing_has_a_name():
    model, records, *_ = sine_spring()
    ladder = rco.improve(model, records[0], candidates=[rco.Effect("quadratic_damping", "link1")])
    assert ladder.effects[-1].label == "unknown force, tabulated at link1"
    assert ladder.steps[-1].validation_rmse[0] < 0.2 * ladder.steps[0].validation_rmse[0]
    assert "a table holds it" in ladder.message


def test_hidden_force_holds_its_columns():
    *_, found = sine_spring()
    hidden = found.hidden_force
    frame = hidden.to_dataframe()
    assert list(frame.columns) == ["d", "v", "force", "std"]
    # the record alone, no law assumed: what it misses stays within its own standard deviation
    inner = slice(100, -100)
    true = 4.0 * np.sin(hidden.d / 0.12)
    missed = (hidden.force - true)[inner]
    assert np.std(missed) < 2.0 * hidden.std.mean()
    assert np.corrcoef(hidden.force[inner], true[inner])[0, 1] > 0.8
    assert max(map(len, str(hidden).splitlines())) <= 80


def test_a_true_law_keeps_its_name_and_all_sums_to_one():
    model, records, *_ = sine_spring()
    rng = np.random.default_rng(7)
    engine = Engine(Structure(model, [rco.Effect("cubic_stiffness", "link1")]), records[0], substeps=8)
    y = engine.run(np.array([300.0])).outputs
    record = rco.Measurement(records[0].inputs, y + 0.03 * y.std() * rng.standard_normal(y.shape), dt=0.02)
    kinds = ("stiffness", "cubic_stiffness", "quadratic_damping", "clearance")
    found = rco.diagnose(model, record, candidates=[rco.Effect(kind, "link1") for kind in kinds])
    named(found, rco.Effect("cubic_stiffness", "link1"), 300.0)
    total = found.none_of_these + sum(row.probability for row in found.ranking)
    assert total == pytest.approx(1.0)
    assert sum(found.places.values()) == pytest.approx(1.0)
    with pytest.raises(rco.ModelError, match="no unknown force"):
        found.law()


def late_record(rng, n=300, late=57):
    """Record of an oscillator behind a delay of whole samples, its model, and its output without noise."""
    system = [np.array(part) for part in ([[0, 1], [-4.0, -1]], [[0], [4.0]], [[1.0, 0]], [[0.0]])]
    u = 5.0 + 2.0 * np.repeat(rng.standard_normal(n // 10), 10)
    seen = np.append(np.zeros(late), u)[:n]
    y = dlsim((*cont2discrete(system, 0.05)[:4], 0.05), seen)[1][:, 0]
    model = ct.ss(*system, states=["x", "v"], inputs="u", outputs="y")
    return model, rco.Measurement(u, y + 0.03 * y.std() * rng.standard_normal(n), dt=0.05), y


@pytest.mark.parametrize("seed", range(4))
def test_a_free_curve_of_an_output_leaves_out_what_a_delay_hides(seed):
    """The hidden samples have no weight: they give the curve no knots, and it finds nothing to explain."""
    model, data, y = late_record(np.random.default_rng(seed))
    late = rco.Effect("output_delay", "y", start={"delay": 57 * 0.05})
    fitted = fitted_from(rco.refine(model, data, [late]), [data], tolerance=0.0)
    assert fitted.refinement.parameter("delay").value == pytest.approx(2.85, abs=0.025)
    signal, hidden = free_form.channel_signal(fitted, "y", 0), fitted.problem.judged(fitted.theta)[0][0] == 0
    assert 50 < hidden.sum() < 60
    assert np.abs(signal - y)[~hidden].max() < 0.1 * y.std()
    assert beside.channel_curve(fitted, "y").d.min() >= signal[~hidden].min()
    (test,) = beside.Beside(residual_tests.TestedResidual(fitted), "y").tests()
    assert test.p_value > 0.001


def test_a_table_beside_an_effect_with_a_state_is_compared():
    """The table feels the states of the model, not those that the lag adds."""
    rng = np.random.default_rng(0)
    model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    blank = rco.Measurement(rng.standard_normal(150), np.zeros(150), dt=0.03)
    y = rco.simulate(model, blank, "zero").outputs
    data = rco.Measurement(blank.inputs, y + 1e-4 * rng.standard_normal(y.shape), dt=0.03)
    narrow = rco.Table(d=[-1e-3, 1e-3], force=[-1e-2, 1e-2])
    place = model.linear.input_labels[0]
    effects = [
        rco.Effect("tabulated", "link1", law=narrow, fixed={"scale": 1.0}),
        rco.Effect("input_lag", place, fixed={"time_constant": 0.01}),
    ]
    found = rco.compare(rco.refine(model, data, effects, offset=False), data)
    assert "leaves the table of tabulated at link1" in " ".join(found.notes)
