"""diagnose on records whose hidden effect is known: verdict, coefficient, words, picture, options."""

from __future__ import annotations

import pickle
import re
from concurrent.futures import ThreadPoolExecutor

import control as ct
import numpy as np
import pytest
from cases import named, slow
from hidden.generator import OUTSIDE, hidden_record
from scipy import stats
from scipy.signal import lfilter

import rcorefine as rco


def diagnosed(seed, *, settings=None, **record):
    hidden = hidden_record(seed, **record)
    return hidden, rco.diagnose(
        hidden.plant.model, hidden.data, candidates=hidden.candidates, **(settings or {})
    )


@pytest.fixture(scope="module")
def friction():
    return diagnosed(31, effect="coulomb_friction", loss=0.2, plant="quarter car", samples=1200)


@pytest.fixture(scope="module")
def nothing():
    return diagnosed(32, effect=None, samples=800)


def least_of(n, rate, level=1e-3):
    """Hits of n below which the rate is refuted at the level."""
    return int(stats.binom.ppf(level, n, rate))


def test_names_the_effect_and_its_coefficient(friction):
    hidden, found = friction
    assert found.verdict == "effect"
    assert (found.best.effect.kind, found.best.effect.place) == (hidden.kind, hidden.place)
    (value,), (std,) = found.best.coefficients.values(), found.best.std.values()
    assert abs(value - hidden.coefficient) < 4 * std
    assert found.best.fit_before < 85 < 96 < found.best.fit_after
    # among the candidates; what is left is for none of them
    assert found.best.probability > 0.99 * (1.0 - found.none_of_these)
    assert found.none_of_these < 0.05


def test_adequate_says_what_would_have_shown(nothing):
    _hidden, found = nothing
    assert found.verdict == "adequate"
    assert found.best is None
    assert found.detectable
    assert all(d.smallest > 0 for d in found.detectable)
    assert "would show" in str(found)


def test_words_fit_the_page_and_the_result_can_be_kept(friction, nothing):
    for _, found in (friction, nothing):
        text = str(found)
        assert max(map(len, text.splitlines())) <= 80
        assert found.verdict.upper() in text
        assert found.verdict in found._repr_html_()
        again = pickle.loads(pickle.dumps(found))
        assert str(again) == text


def test_picture_shows_the_force_without_a_law():
    from rcorefine.inference.free_form import estimated_force

    hidden, found = diagnosed(304, effect="cubic_stiffness", loss=0.2)
    plot = found.plot()
    assert plot.axes.shape == (2, 2)
    port = hidden.plant.model.port(hidden.place)
    force, states, _std = estimated_force(
        found.base, found.best.refinement.rmse, port, found.ordered_records()[0]
    )
    d = port.position @ states + port.position_input @ hidden.data.inputs
    # no law went in, yet the force follows the cube of the displacement
    inner = slice(100, -100)
    slope = np.polyfit(d[inner] ** 3, force[inner], 1)[0]
    assert np.corrcoef(d[inner] ** 3, force[inner])[0, 1] > 0.9
    assert slope == pytest.approx(hidden.coefficient, rel=0.25)


def test_refine_continues_from_the_diagnosis(friction):
    _hidden, found = friction
    better = found.refine()
    assert float(better.fit[0]) == pytest.approx(found.best.fit_after, abs=0.2)


def test_threads_change_nothing(friction):
    hidden, found = friction
    with ThreadPoolExecutor(2) as pool:
        again = rco.diagnose(hidden.plant.model, hidden.data, candidates=hidden.candidates, executor=pool)
    assert [row.effect for row in again.ranking] == [row.effect for row in found.ranking]
    assert again.best.coefficients == found.best.coefficients


def test_two_amplitudes_agree_on_a_true_law():
    hidden = hidden_record(33, plant="quarter car", effect="quadratic_damping", loss=0.2, samples=1000)
    half = rco.Measurement(0.3 * hidden.data.inputs, hidden.at_scale(0.3), dt=hidden.data.dt, hold="foh")
    found = rco.diagnose(hidden.plant.model, [hidden.data, half], candidates=hidden.candidates)
    named(found, rco.Effect(hidden.kind, hidden.place), hidden.coefficient)
    assert any("they agree" in note for note in found.notes)


def test_two_amplitudes_refute_a_law_that_only_mimics():
    hidden = hidden_record(34, plant="quarter car", effect="coulomb_friction", loss=0.2, samples=1000)
    half = rco.Measurement(0.3 * hidden.data.inputs, hidden.at_scale(0.3), dt=hidden.data.dt, hold="foh")
    mimic = [rco.Effect("damping", hidden.place)]
    found = rco.diagnose(hidden.plant.model, [hidden.data, half], candidates=mimic)
    assert found.verdict == "unexplained"


@pytest.mark.parametrize("effort", [0.0, *slow(2.0)])
def test_a_search_says_what_its_effort_left_out(effort):
    hidden = hidden_record(34, plant="quarter car", effect="coulomb_friction", loss=0.2, samples=1000)
    others = [e for e in hidden.candidates if "friction" not in e.kind and e.kind != "hysteresis"]
    found = rco.diagnose(hidden.plant.model, hidden.data, candidates=others, effort=effort)
    assert found.verdict == "unexplained"
    said = [note for note in found.notes if "refits" in note]
    assert len(said) == (effort == 0.0)
    assert all(re.search(r"refits. Not tried: .*; effort=1 goes on", note) for note in said)


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"significance": 2.0}, ct.ControlArgument),
        ({"nonsense": 1}, TypeError),
        ({"effort": -1.0}, ct.ControlArgument),
    ],
)
def test_bad_options_are_refused(nothing, settings, error):
    hidden, _ = nothing
    with pytest.raises(error):
        rco.diagnose(hidden.plant.model, hidden.data, candidates=hidden.candidates, **settings)


def test_short_record_is_refused(nothing):
    hidden, _ = nothing
    short = rco.Measurement(
        hidden.data.inputs[:, :30], hidden.data.outputs[:, :30], dt=hidden.data.dt, hold="foh"
    )
    with pytest.raises(rco.DataError, match="too short"):
        rco.diagnose(hidden.plant.model, short, candidates=hidden.candidates)


NOISES = ("white", "ar", "resonant", "t3")
BENCHES = ("chain", "motor", "quarter car", "RLC", "thermal")


@pytest.mark.slow
def test_no_alarm_where_nothing_is_missing():
    """One rate over all kinds of noise, ten records of each."""
    verdicts, n = [], 40
    for i in range(n):
        seed, kind = 900 + i // len(NOISES), NOISES[i % len(NOISES)]
        verdicts.append(diagnosed(seed, effect=None, noise_kind=kind, samples=700)[1].verdict)
    assert verdicts.count("adequate") >= least_of(n, 0.95)


@pytest.mark.slow
def test_hidden_effects_are_named():
    """Right in 95 of 100, eight records of each plant, and a wrong name alone in fewer than 5 of 100."""
    right, wrong, n = 0, 0, 40
    for i in range(n):
        seed, plant = 950 + i // len(BENCHES), BENCHES[i % len(BENCHES)]
        hidden, found = diagnosed(seed, plant=plant, loss=0.2, samples=1000)
        truth = (hidden.kind, hidden.place)
        names = [(e.kind, e.place) for e in found.ambiguous]
        right += found.verdict != "unexplained" and truth in names
        wrong += found.verdict == "effect" and truth not in names
    assert right >= least_of(n, 0.95)
    assert wrong <= n - least_of(n, 0.95)


@pytest.mark.slow
@pytest.mark.parametrize("kind", OUTSIDE)
def test_what_no_candidate_explains_is_said_to_be_unexplained(kind):
    n = 6
    verdicts = [diagnosed(970 + i, effect=kind, loss=0.15)[1].verdict for i in range(n)]
    assert verdicts.count("unexplained") >= least_of(n, 0.95)


@pytest.mark.parametrize(
    ("color", "share", "doubted"), [(0.9, 0.5, True), (0.0, 0.5, False), (0.9, 0.05, False)]
)
def test_much_noise_of_a_color_is_doubted(color, share, doubted):
    model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    rng = np.random.default_rng(0)
    w = rng.standard_normal(2000)
    y = ct.forced_response(model.system.sample(0.02), inputs=w).outputs
    noise = lfilter([1.0], [1.0, -color], rng.standard_normal(2000))
    data = rco.Measurement(w, y + share * y.std() * noise / noise.std(), dt=0.02)
    found = rco.diagnose(model, data, candidates=[rco.Effect("stiffness", "link1")])
    assert found.verdict == "adequate"
    assert ("cannot be distinguished from colored noise" in str(found).replace("\n", " ")) == doubted


def test_an_offset_of_a_sensor_beside_an_integrator_is_no_effect():
    """An arm that turns freely with a pendulum on it: the level of the angle that has one is a nuisance."""
    M = np.array([[0.7, 0.06], [0.06, 0.024]])
    W, C = np.linalg.inv(M), np.diag([0.8, 0.01])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-W @ np.diag([0.0, 0.6]), -W @ C]])
    model = ct.ss(A, np.vstack([np.zeros((2, 1)), W[:, :1]]), np.eye(4)[:2], 0)
    rng = np.random.default_rng(4)
    w = np.repeat(rng.choice([-1.0, 1.0], 60), 15)  # steps, seldom
    y = ct.forced_response(model.sample(0.05), inputs=w).outputs
    size = y.std(axis=1, keepdims=True)
    data = rco.Measurement(w, y + 0.5 * size + 0.01 * size * rng.standard_normal(y.shape), dt=0.05)
    found = rco.diagnose(model, data)
    assert found.verdict == "adequate"
    (level,) = [row for row in found.base.parameters if row.place == "y[1]"]
    assert abs(level.value - 0.5 * size[1, 0]) < 4 * level.std
    assert not [row for row in found.checks if row.what == "closed loop"]  # steps follow nothing


def test_a_gain_is_told_as_what_the_sensor_reads(rng):
    """A swapped wire: the gain of the model has to change by -2, and is -1 then."""
    model = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs="u", outputs="y", states=["x"])
    u = rng.standard_normal(600)
    _, y = ct.forced_response(model.sample(0.1), inputs=u)
    noisy = -y + 0.01 * y.std() * rng.standard_normal(600)
    data = rco.Measurement(u, noisy, dt=0.1, input_labels="u", output_labels="y")
    found = rco.diagnose(model, data, candidates=[rco.Effect("output_gain", "y")])
    said = re.search(r"y is then (\S+) times what the model has there", " ".join(str(found).split()))
    assert float(said[1]) == pytest.approx(-1.0, abs=0.01)
    assert "it is reversed" in " ".join(str(found).split())


@pytest.mark.parametrize(("factor", "turned"), [(-1.0, True), (-2.0, True), (0.6, False)])
def test_a_wiring_that_is_reversed_in_a_frequency_response_is_called_so(rng, factor, turned):
    chain = rco.mass_spring_damper([1.0, 1.5], [0.5, 0.4], [400.0, 300.0])
    omega = np.geomspace(2, 60, 80)
    G = chain.system(1j * omega) * np.array([factor, 1.0])[:, None, None]
    size = 0.01 * np.abs(G).max()
    G = G + size * (rng.standard_normal(G.shape) + 1j * rng.standard_normal(G.shape))
    found = rco.diagnose(chain, rco.FrequencyResponse(G, omega, std=size))
    assert [(effect.kind, effect.place) for effect in found.effects] == [("output_gain", "q1")]
    said = " ".join(str(found).split())
    value = float(re.search(r"q1 is then (\S+) times what the model has there", said)[1])
    assert value == pytest.approx(factor, rel=0.04)
    assert ("it is reversed (swapped wires" in said) == turned
