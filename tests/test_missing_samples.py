"""Records with gaps and slow sensors: samples that were not measured count nowhere."""

import json
from functools import cache

import control as ct
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import cholesky, solve_triangular, toeplitz
from scipy.optimize import least_squares
from scipy.signal import lfilter
from scipy.stats import binom

import rcorefine as rco
from rcorefine.exceptions import DataError
from rcorefine.inference.whitening import Whitener, over_gaps

DT, STIFFNESS, FOUND = 0.05, 100.0, 90.0
KINDS = ("random", "block", "slow", "all")


def chain(stiffness=STIFFNESS):
    return rco.mass_spring_damper([1.0, 1.0], [0.4, 0.4], [stiffness, 60.0], sensors="displacement")


@cache
def clean(effect="stiffness", n=1500):
    """Input and outputs of the true plant."""
    w = np.repeat(np.random.default_rng(5).standard_normal((1, n // 5)), 5, axis=1)
    blank = rco.Measurement(w, np.zeros((2, n)), dt=DT)
    if effect == "stiffness":
        return w, rco.simulate(chain(FOUND), blank, "zero").outputs
    hidden = rco.Effect("coulomb_friction", "link1", fixed={"force": 0.5})
    return w, rco.simulate(chain(), blank, "zero", effects=[hidden]).outputs


def gaps(kind, shape, seed=0):
    """Flags of the samples that were not measured."""
    gone = np.zeros(shape, dtype=bool)
    if kind in ("random", "mixed"):
        gone[0] = np.random.default_rng(seed).random(shape[1]) < 0.2
    if kind in ("block", "all", "mixed"):
        gone[1, shape[1] // 3 : shape[1] // 2] = True
    if kind in ("slow", "all"):
        gone[0] = np.arange(shape[1]) % 10 != 4
    return gone


def record(kind, noise=0.01, seed=0, effect="stiffness", n=1500, color=0.0):
    w, y = clean(effect, n)
    e = np.random.default_rng(seed).standard_normal(y.shape)
    e = lfilter([np.sqrt(1 - color**2)], [1, -color], e, axis=1)
    y = y + noise * y.std(axis=1, keepdims=True) * e
    y[gaps(kind, y.shape, seed)] = np.nan
    return rco.Measurement(w, y, dt=DT, missing="hold-out")


def refined(data):
    return rco.refine(chain(), data, [rco.Effect("stiffness", "link1")])


# ---------------------------------------------------------------- records
def test_without_the_option_nan_is_refused_and_the_message_names_it():
    with pytest.raises(DataError, match=r"'y\[0\]' is NaN at sample 2.*missing='hold-out'"):
        rco.Measurement(np.ones(5), [0, 1, np.nan, 3, 4], dt=1.0)


@pytest.mark.parametrize(("w", "y"), [([1, np.nan, 1], [0, 1, 2]), ([1, 1, 1], [0, np.inf, 2])])
def test_inputs_are_whole_and_infinite_outputs_are_refused(w, y):
    with pytest.raises(DataError, match="sample 1"):
        rco.Measurement(w, y, dt=1.0, missing="hold-out")


def test_parts_keep_gaps_and_json_has_null():
    data = record("all")
    first, second = data.split(0.4)
    assert_array_equal(np.hstack([first.outputs, second.outputs]), data.outputs)
    assert_array_equal(data.segment(10.0, 30.0).outputs, data.outputs[:, 200:600])
    assert_array_equal(np.isnan(data.deviation().outputs), np.isnan(data.outputs))
    assert_allclose(np.nanmean(data.deviation().outputs, axis=1), 0.0, atol=1e-12)
    assert json.loads(json.dumps(data.to_dict()))["outputs"][0][:5] == [None] * 4 + [data.outputs[0, 4]]
    assert data.there.sum() == np.isfinite(data.outputs).sum()
    assert rco.Measurement([1, 1], [0, 1], dt=1.0).there is None


def test_masked_outputs_are_gaps():
    data = rco.Measurement(np.ones(4), np.ma.masked_greater([1, 2, 9, 3], 5), dt=0.1, missing="hold-out")
    assert_array_equal(data.outputs, [[1, 2, np.nan, 3]])


def test_empty_cells_become_gaps(tmp_path):
    path = tmp_path / "bench.csv"
    path.write_text("t,u,y,T\n0,1,0,5\n0.1,1,,\n0.2,1,nan,\n0.3,2,3,\n0.4,2,1,7\n")
    with pytest.raises(DataError, match=r"line 3, column 'y'.*missing='hold-out'"):
        rco.Measurement.from_csv(path, "u", ["y", "T"], time="t")
    wanted = [[0, np.nan, np.nan, 3, 1], [5, np.nan, np.nan, np.nan, 7]]
    option = {"time": "t", "missing": "hold-out"}
    assert_array_equal(rco.Measurement.from_csv(path, "u", ["y", "T"], **option).outputs, wanted)
    read = rco.read_record(path, inputs="u", outputs=["y", "T"], **option)
    assert_array_equal(read.outputs, wanted)
    frame = pytest.importorskip("pandas").read_csv(path)
    assert_array_equal(rco.Measurement.from_frame(frame, "u", ["y", "T"], **option).outputs, wanted)
    path.write_text("t,u,y\n0,1,0\n0.1,,1\n0.2,1,1\n")
    with pytest.raises(DataError, match="line 3, column 'u'"):
        rco.Measurement.from_csv(path, "u", "y", **option)


@pytest.mark.parametrize(
    "use",
    [
        lambda data: data.frequency_response(),
        lambda data: data.decimate(2),
        lambda data: data.detrend(),
        lambda data: data.filter(high=20.0),
        lambda data: rco.compare(chain(), data).plot("residual"),
    ],
)
def test_what_needs_all_samples_says_where_the_first_gap_is(use):
    with pytest.raises(DataError, match=r"needs all samples; output 'y\[1\]' has none at sample 500 "):
        use(record("block"))


# ---------------------------------------------------------------- noise
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_innovations_over_gaps_are_those_of_the_exact_covariance(share):
    a, n = np.array([1.0, -1.5, 0.8]), 80
    response = lfilter([1.0], a, np.eye(1, 4000)[0])
    R = toeplitz([response[: 4000 - k] @ response[k:] for k in range(n)])
    rng = np.random.default_rng(1)
    known, X = rng.random(n) >= share, rng.standard_normal((n, 2))
    X[~known] = np.nan
    exact = solve_triangular(cholesky(R[np.ix_(known, known)], lower=True), X[known], lower=True)
    found = over_gaps(a, X)
    assert len(found) == known.sum() - 2
    # what the filter takes for its first past is forgotten
    assert_allclose(found[-10:], exact[-10:], rtol=0, atol=1e-5)


def test_whitener_over_random_gaps_and_of_a_slow_sensor():
    e = np.random.default_rng(0).standard_normal(6000)
    x = lfilter([1.0], [1, -1.5, 0.8], e)
    for kind, step in (("random", 1), ("slow", 10)):
        y = x.copy()
        y[gaps(kind, (2, x.size))[0]] = np.nan
        blocks = [y[None, :2500], y[None, 2500:]]
        whitener = Whitener.fit(blocks)
        white = whitener.apply(blocks)
        assert whitener.steps == (step,)
        assert white.size == whitener.outputs(blocks).size == np.isfinite(y).sum() - 2 * whitener.orders[0]
        assert abs(white.std() - 1) < 0.01
        assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 3 / np.sqrt(white.size)


# ---------------------------------------------------------------- refine, compare
@pytest.mark.parametrize("kind", KINDS)
def test_without_noise_the_coefficient_is_exact(kind):
    found = refined(record(kind, noise=0.0))
    assert_allclose(found.parameters[0].value, FOUND, rtol=1e-9)
    assert found.fit.min() > 99.9999


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("color", [0.0, 0.9])
def test_coefficient_is_right_within_its_standard_deviation(kind, color):
    row = refined(record(kind, seed=3, color=color)).parameters[0]
    assert abs(row.value - FOUND) < 3 * row.std


def test_slow_sensor_agrees_with_an_independent_fit_of_the_samples_there():
    """Whole model by `least_squares` on the samples that were measured, levels of noise known."""
    data, sigma = record("slow", seed=2), 0.01 * clean()[1].std(axis=1)
    there = data.there

    def error(p):
        y = rco.simulate(chain(p[0]), data, "zero").outputs + p[1:3, None]
        return ((y - data.outputs) / sigma[:, None])[there]

    alone = least_squares(error, [95.0, 0.0, 0.0], x_scale=[1.0, 1e-3, 1e-3], xtol=1e-14, ftol=1e-14)
    std = np.sqrt(np.linalg.inv(alone.jac.T @ alone.jac)[0, 0])
    effects = [rco.Effect("stiffness", "link1")]
    row = rco.refine(chain(), data, effects, x0="zero", noise=sigma).parameters[0]
    assert_allclose(row.value, alone.x[0], rtol=1e-6)
    assert_allclose(row.std, std, rtol=0.1)


def test_standard_deviation_grows_as_samples_are_lost():
    whole, slow = (refined(record(kind, seed=1)).parameters[0].std for kind in ("", "slow"))
    lost = refined(record("all", seed=1)).parameters[0].std
    assert 1.0 < slow / whole < np.sqrt(2000 / 1100) * 1.3
    assert slow < lost


def test_compare_counts_the_samples_that_are_there():
    data = record("all")
    found = rco.compare([chain(), chain(FOUND)], data)
    for m, i in np.ndindex(2, 2):
        seen = ~np.isnan(data.outputs[i])
        y, run = data.outputs[i, seen], found.runs[m, i, seen]
        fit = 100 * (1 - np.linalg.norm(y - run) / np.linalg.norm(y - y.mean()))
        assert_allclose(found.fit[m, i], fit, rtol=1e-12)
        assert_allclose(found.rmse[m, i], np.sqrt(np.mean((y - run) ** 2)), rtol=1e-12)
    assert "nan" not in str(found)
    assert "were not measured" in str(found.failures[0])
    json.dumps(found.to_dict())
    found.plot()


def test_initial_state_of_a_discrete_model_too():
    data = record("mixed", noise=0.0)
    found = rco.compare(ct.sample_system(chain(FOUND).system, DT), data)
    assert found.fit.min() > 99.99


def test_interpolated_gaps_are_worse_than_gaps_left_out():
    """What people did: straight lines into the gaps of the slow sensor."""
    data = record("slow", noise=0.001)
    at = np.arange(data.n_samples)
    seen = data.there[0]
    filled = np.vstack([np.interp(at, at[seen], data.outputs[0, seen]), data.outputs[1]])
    with pytest.warns(rco.IdentifiabilityWarning):
        wrong = refined(rco.Measurement(data.inputs, filled, dt=DT)).parameters[0].value
    right = refined(data).parameters[0].value
    assert abs(right - FOUND) < 0.01 < abs(wrong - FOUND)


# ---------------------------------------------------------------- nothing leaks
@pytest.mark.parametrize("kind", ["mixed", "all"])
def test_garbage_below_the_mask_changes_nothing(kind):
    data = record(kind)
    answers = []
    for garbage in (0.0, 1e30, -7.0):
        y = np.ma.array(np.where(data.there, data.outputs, garbage), mask=~data.there)
        other = rco.Measurement(data.inputs, y, dt=DT, missing="hold-out")
        found = refined(other)
        answers.append([found.theta, found.covariance, found.fit, rco.compare(chain(), other).fit])
    for other in answers[1:]:
        for one, same in zip(answers[0], other, strict=True):
            assert_array_equal(one, same)


def test_the_option_alone_changes_no_bit():
    data = record("")
    plain = rco.Measurement(data.inputs, data.outputs, dt=DT)
    for one, other in zip(
        (refined(data).covariance, rco.compare(chain(), data).fit),
        (refined(plain).covariance, rco.compare(chain(), plain).fit),
        strict=True,
    ):
        assert_array_equal(one, other)


def test_an_observer_does_not_correct_in_a_gap():
    from rcorefine.engine.engine import Engine
    from rcorefine.engine.observer import observer_gain
    from rcorefine.engine.structure import Structure
    from rcorefine.models.conversion import as_physical

    data, structure = record("mixed"), Structure(as_physical(chain()))
    filled = rco.Measurement(data.inputs, np.nan_to_num(data.outputs, nan=9.0), dt=DT)
    theta = np.zeros(0)
    gain = observer_gain(structure, theta, data, 1.0)
    runs = [
        Engine(structure, data).run(theta, gain=gain),
        Engine(structure, filled).run(theta, gain=gain, use=data.there.T),
    ]
    assert_array_equal(runs[0].outputs, runs[1].outputs)


# ---------------------------------------------------------------- diagnosis
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mixed", "all"])
def test_diagnose_names_a_wrong_stiffness(kind):
    found = rco.diagnose(chain(), record(kind))
    assert (found.verdict, found.effects[0].label) == ("effect", "stiffness at link1")


def test_check_and_localize_damage_say_right_numbers():
    data = record("all")
    lost = rco.localize_damage(chain(), data)
    assert [row.place for row in lost.named] == ["link1"]
    seen = str(rco.check(chain(FOUND), data))
    assert "STOP" not in seen
    assert "nan" not in seen


@pytest.mark.slow
def test_diagnose_names_hidden_friction():
    found = rco.diagnose(chain(), record("mixed", effect="friction"))
    row = found.ranking[0]
    assert (found.verdict, found.effects[0].label) == ("effect", "coulomb_friction at link1")
    assert abs(row.coefficients["force"] - 0.5) < 3 * row.std["force"]


@pytest.mark.slow
def test_improve_ends_at_the_noise():
    found = rco.improve(chain(), record("all"))
    assert found.verdict == "adequate"


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("color", [0.0, 0.9])
def test_two_standard_deviations_cover_the_truth(kind, color):
    """In 40 records, within the binomial bound of 95 %."""
    rows = [refined(record(kind, seed=seed, color=color)).parameters[0] for seed in range(100, 140)]
    inside = sum(abs(row.value - FOUND) < 2 * row.std for row in rows)
    assert inside >= binom.ppf(0.005, 40, 0.954)


@pytest.mark.parametrize(
    "verb", [rco.compare, rco.refine, rco.check, rco.diagnose, rco.localize_damage, rco.improve]
)
def test_an_output_without_any_sample_is_refused_at_the_door(verb):
    plant = rco.mass_spring_damper([1.0, 1.0], [0.5, 0.4], [80.0, 60.0])
    outputs = np.ones((2, 600))
    outputs[1] = np.nan
    data = rco.Measurement(np.ones((1, 600)), outputs, dt=0.02, missing="hold-out")
    with pytest.raises(rco.DataError, match=r"'y\[1\]' of record 'measured' has none of its 600 samples"):
        verb(plant, data)
