"""The state behind the explorer, without any page: steps, errors, the way back, what it hands over."""

from __future__ import annotations

import subprocess
import sys

import control as ct
import numpy as np
import pytest
from inner import Structure

import rcorefine as rco
from rcorefine.explorer import Exploration

WEAK = rco.Effect("stiffness", "link1")
CUBIC = rco.Effect("cubic_stiffness", "link1")


def chain(stiffness=100.0):
    return rco.mass_spring_damper([1.0], [0.4], [stiffness], sensors="displacement")


def record(true, n=800, noise=0.02, offset=0.0, seed=0, **names):
    rng = np.random.default_rng(seed)
    force = 10 * rng.standard_normal(n)
    y = rco.simulate(true, rco.Measurement(force, np.zeros(n), dt=0.02), "zero").outputs[0]
    y = y + noise * y.std() * rng.standard_normal(n) + offset * y.std()
    given = {"input_labels": "force", "output_labels": "q1", "output_units": "m"} | names
    return rco.Measurement(force, y, dt=0.02, **given)


@pytest.fixture
def tried():
    return Exploration(chain(), record(chain(90.0)))


def test_begins_where_refine_begins(tried):
    """No effect yet: the error is that of the model with its offset and initial state fitted."""
    bare = rco.refine(chain(), tried.data)
    assert tried.error == pytest.approx(100.0 - bare.fit[0], abs=1e-6)
    assert tried.effects == ()
    assert [step.action for step in tried.steps] == ["start"]


def test_an_offset_is_not_taken_for_an_effect():
    """A sensor that reads too much is allowed for before anything is added."""
    plain, shifted = (Exploration(chain(), record(chain(90.0), offset=c)) for c in (0.0, 0.5))
    assert shifted.error == pytest.approx(plain.error, abs=0.5)


def test_the_fitted_error_is_what_refine_says(tried):
    before = tried.error
    tried.add(WEAK)
    assert tried.error == pytest.approx(before, rel=1e-3)  # absent as yet
    step = tried.fit()
    again = rco.refine(chain(), tried.data, [WEAK])
    assert step.error == 100.0 - again.fit[0]
    assert tried.refinement.parameter("stiffness").value == again.parameter("stiffness").value
    assert step.error < 0.2 * before
    # ... and the run that is drawn has that error
    y = tried.record.outputs
    assert np.linalg.norm(step.runs - y) / np.linalg.norm(y - y.mean()) == pytest.approx(step.error / 100)


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        (WEAK, {"stiffness": -8.0}),
        (CUBIC, {"cubic_stiffness": 40.0}),
        (rco.Effect("coulomb_friction", "link1"), {"force": 0.5}),
        (rco.Effect("hysteresis", "link1"), {"force": 1.0, "displacement": 0.1}),
        (rco.Effect("input_delay", "force"), {"delay": 0.013}),
    ],
)
def test_a_run_set_by_hand_is_that_of_simulate(effect, values):
    """Another way to the same model: refine with the coefficients held, and simulate."""
    data = record(chain(90.0), 400)
    tried = Exploration(chain(), data)
    step = tried.add(effect, **values)
    assert tried.coefficients(effect) == values
    held = rco.refine(chain(), data, [effect.replace(fixed=values)], offset=False)
    start = step.refinement.initial_states[0]
    free = rco.simulate(held, data, start).outputs
    offset = step.runs - free
    assert step.runs == pytest.approx(rco.simulate(step.refinement, data, start).outputs)
    assert np.abs(offset - offset.mean()).max() < 0.02 * step.runs.std()


def test_a_slider_moves_the_curve_and_changes_nothing(tried):
    tried.add(WEAK)
    steps = tried.steps
    runs, error = tried.preview(WEAK, stiffness=-10.0)
    assert tried.steps == steps
    assert error < 0.2 * tried.error
    assert tried.move(WEAK, stiffness=-10.0).error == pytest.approx(error, rel=0.05)
    assert runs == pytest.approx(tried.steps[-1].runs, abs=0.05 * runs.std())
    assert error == pytest.approx(tried.fit().error, rel=0.1)  # the truth by hand is as good as the fit


def test_what_was_fitted_stays_while_another_is_added():
    """After a fit every coefficient stands where the fit left it until it is moved itself."""
    tried = Exploration(chain(), record(chain(90.0)))
    tried.add(WEAK)
    fitted = tried.fit()
    value = tried.coefficients(WEAK)["stiffness"]
    step = tried.add(CUBIC, cubic_stiffness=0.0)
    assert step.error == pytest.approx(fitted.error, abs=1e-3)
    assert tried.coefficients(WEAK) == {"stiffness": pytest.approx(value)}


def test_moves_of_one_effect_are_one_step_back(tried):
    tried.add(WEAK)
    for value in (-2.0, -5.0, -30.0):
        tried.move(WEAK, stiffness=value)
    assert [step.action for step in tried.steps] == ["start", "add", "move"]
    errors = [step.error for step in tried.steps]
    assert tried.undo().error == errors[1]
    assert tried.coefficients(WEAK) == {"stiffness": 0.0}
    tried.undo()
    assert tried.effects == ()
    assert tried.undo() is tried.steps[0]  # the initial model stays
    assert tried.error == errors[0]


def test_two_explorations_share_nothing():
    model, data = chain(), record(chain(90.0))
    one, two = Exploration(model, data), Exploration(model, data)
    one.add(WEAK)
    assert two.effects == ()
    assert len(two.steps) == 1


def test_failures_force_and_candidates_lead_to_the_cause():
    """A hardening spring that the model lacks: its place, the shape of its force, its law."""
    data = record(Held(CUBIC.replace(fixed={"cubic_stiffness": 200.0})), 1500)
    tried = Exploration(chain(), data)
    row = next(row for row in tried.comparison.failures if row.values.get("place") == "link1")
    force = tried.force(row)
    assert force.place == "link1"
    grid = np.abs(force.position) > force.position.std()
    assert np.corrcoef(force.force[grid], force.position[grid] ** 3)[0, 1] > 0.8
    found = tried.candidates(row, force)
    shares = {one.effect.kind: one.share for one in found}
    assert all(one.effect.place == "link1" for one in found)
    assert shares["cubic_stiffness"] > 0.8 > shares["damping"] + 0.5
    best = next(one for one in found if one.effect.kind == "cubic_stiffness")
    assert best.coefficients["cubic_stiffness"] == pytest.approx(200.0, rel=0.5)
    assert tried.add(best.effect, **best.coefficients).error < 0.5 * tried.steps[0].error


class Held:
    """A model with effects at given values, for `simulate`: made without a fit."""

    def __init__(self, *effects):
        self.physical_model = chain()
        self.effects = effects

    def simulation_structure(self):
        return Structure(self.physical_model, self.effects), np.zeros(0), 8


def test_every_candidate_can_be_added_as_it_is_proposed():
    """Orders and bounds of coefficients are kept, whatever the force looks like."""
    tried = Exploration(chain(), record(chain(60.0), 400))
    force = tried.force()
    for one in [*tried.candidates(force=force), *tried.candidates()]:
        try:
            tried.add(one.effect, **one.coefficients)
        except rco.DivergenceError:
            continue  # a spring of minus more than there is: said, and nothing has changed
        assert tried.effects[-1] == one.effect
        name = one.effect.coefficients[0]
        lower, upper = tried.reach(one.effect, name)
        assert lower <= one.coefficients[name] <= upper
        assert lower < upper
        tried.undo()
    assert len(tried.steps) == 1


def test_a_model_that_diverges_changes_nothing(tried):
    tried.add(WEAK)
    steps = tried.steps
    for change in (tried.move, tried.preview):
        with pytest.raises(rco.DivergenceError, match="move them back"):
            change(WEAK, stiffness=-1e5)
    assert tried.steps == steps


def test_wrong_calls_say_what_is_wrong(tried):
    with pytest.raises(ct.ControlArgument, match="one record in time"):
        Exploration(chain(), [tried.data, tried.data])
    with pytest.raises(rco.ModelError, match=r"was not added; there are none"):
        tried.move(WEAK, stiffness=1.0)
    with pytest.raises(rco.ModelError, match="no port 'nowhere'"):
        tried.add(rco.Effect("stiffness", "nowhere"))
    tried.add(WEAK)
    with pytest.raises(rco.ModelError, match="already"):
        tried.add(WEAK)
    with pytest.raises(rco.ModelError, match="no damping, only stiffness"):
        tried.preview(WEAK, damping=1.0)
    with pytest.raises(ct.ControlArgument, match="stiffness"):
        tried.move(WEAK, stiffness=np.nan)


@pytest.mark.parametrize("last", ["fit", "move"])
def test_the_script_comes_to_the_same_model(tmp_path, monkeypatch, last):
    tried = Exploration(chain(), record(chain(90.0), name="a\nimport os"))
    tried.add(WEAK)
    tried.fit() if last == "fit" else tried.move(WEAK, stiffness=-7.0)
    monkeypatch.chdir(tmp_path)
    np.savez("record.npz", force=tried.data.inputs[0], q1=tried.data.outputs[0])
    space: dict[str, object] = {"print": lambda *_: None}
    exec(compile(tried.script(), "script", "exec"), space)
    assert space["better"].fit == pytest.approx(tried.steps[-1].fit, abs=0.05)


def test_the_report_tells_the_steps(tmp_path, tried, without_pictures):
    tried.add(WEAK)
    tried.fit()
    text = tried.report(tmp_path / "report.html").read_text()
    assert "add stiffness at link1: error" in text
    assert f"fit: error {tried.error:.3g} %" in text
    assert "rco.refine(model, data, effects)" in text
    tried.move(WEAK, stiffness=-3.0)
    assert "Set by hand" in tried.report(tmp_path / "report.html").read_text()


def test_verdict_and_check(tried):
    assert tried.diagnose().verdict != "adequate"
    tried.add(WEAK)
    tried.fit()
    assert tried.diagnose().verdict == "adequate"
    assert {row.what for row in tried.check().rows} >= {"gain", "delay"}


def test_free_runs_in_windows():
    """A model that integrates begins anew in each window, as in refine."""
    motor = rco.dc_motor(gain=2.0, time_constant=0.5, inputs="voltage", sensors="angle", outputs="angle")
    rng = np.random.default_rng(3)
    volts = rng.standard_normal(600)
    y = rco.simulate(motor, rco.Measurement(volts, np.zeros(600), dt=0.05), "zero").outputs[0]
    data = rco.Measurement(
        volts,
        y + 0.01 * y.std() * rng.standard_normal(600),
        dt=0.05,
        input_labels="voltage",
        output_labels="angle",
    )
    tried = Exploration(motor, data)
    assert tried.refinement.initial_states.shape[0] > 1
    place = tried.candidates()[0].effect
    tried.add(place)
    assert tried.error == pytest.approx(tried.steps[0].error, abs=0.5)


def test_needs_no_page():
    code = "import sys, rcorefine.explorer; sys.exit('panel' in sys.modules or 'bokeh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
