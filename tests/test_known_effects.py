"""Plants with effects of known size: `simulate(effects=)` against python-control, and what it refuses."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest

import rcorefine as rco

CHAIN = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
DT = 0.02


def blank(n=300):
    force = 10 * np.random.default_rng(0).standard_normal(n)
    return rco.Measurement(force, np.zeros(n), dt=DT, hold="foh")


@pytest.mark.parametrize(
    ("fixed", "force"),
    [
        ({"cubic_stiffness": 60.0}, lambda d, v: 60.0 * d**3),
        ({"quadratic_damping": 2.0}, lambda d, v: 2.0 * v * abs(v)),
        ({"force": 0.8, "width": 0.05}, lambda d, v: 0.8 * np.tanh(v / 0.05)),
    ],
)
def test_the_plant_is_that_of_python_control(fixed, force):
    kind = next(iter(fixed)) if "force" not in fixed else "coulomb_friction"
    data = blank()
    plant = ct.nlsys(
        lambda t, x, u, params: [x[1], u[0] - 0.4 * x[1] - 100 * x[0] - force(*x)],
        lambda t, x, u, params: x[0], inputs=1, outputs=1, states=2,
    )  # fmt: skip
    tight = {"rtol": 1e-9, "atol": 1e-11, "max_step": DT}
    y = ct.input_output_response(plant, data.timepts, data.inputs[0], solve_ivp_kwargs=tight).outputs
    run = rco.simulate(CHAIN, data, "zero", effects=[rco.Effect(kind, "link1", fixed=fixed)])
    np.testing.assert_allclose(run.outputs[0], y, atol=2e-4 * y.std())


def test_effects_come_beside_those_of_a_refinement():
    data = blank()
    spring = rco.Effect("stiffness", "link1", fixed={"stiffness": -10.0})
    soft = rco.mass_spring_damper([1.0], [0.4], [90.0], sensors="displacement")
    y = rco.simulate(soft, data, "zero").outputs
    better = rco.refine(CHAIN, rco.Measurement(data.inputs, y, dt=DT, hold="foh"), [spring], offset=False)
    cubic = rco.Effect("cubic_stiffness", "link1", fixed={"cubic_stiffness": 60.0})
    both = rco.simulate(better, data, "zero", effects=[cubic]).outputs
    np.testing.assert_allclose(both, rco.simulate(soft, data, "zero", effects=[cubic]).outputs, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "effect", "words"),
    [
        (CHAIN, rco.Effect("coulomb_friction", "link1"), "give the value of force in fixed="),
        (CHAIN, rco.Effect("stiffness", "nowhere", fixed={"stiffness": 1.0}), "no port 'nowhere'"),
        (CHAIN.system.sample(DT), rco.Effect("stiffness", "x1", fixed={"stiffness": 1.0}), "continuous time"),
    ],
)
def test_what_cannot_be_simulated_is_said(model, effect, words):
    with pytest.raises(rco.ModelError, match=words):
        rco.simulate(model, blank(), "zero", effects=[effect])


def test_a_refinement_is_made_again_by_its_script(tmp_path, monkeypatch):
    data = blank(400)
    y = 0.9 * rco.simulate(CHAIN, data, "zero").outputs
    (force,), (moved,) = CHAIN.linear.input_labels, CHAIN.linear.output_labels
    data = rco.Measurement(data.inputs, y, dt=DT, hold="foh", input_labels=force, output_labels=moved)
    better = rco.refine(CHAIN, data, [rco.Effect("input_gain", force)])
    monkeypatch.chdir(tmp_path)
    np.savez("record.npz", **{force: data.inputs[0], moved: data.outputs[0]})
    space: dict[str, object] = {"print": lambda *_: None}
    exec(better.script(data), space)
    assert space["better"].theta == pytest.approx(better.theta, rel=1e-6)
    assert "data = ..." in better.script()


def test_results_answer_in_sentences():
    data = blank(600)
    record = rco.Measurement(data.inputs, 0.9 * rco.simulate(CHAIN, data, "zero").outputs, dt=DT, hold="foh")
    compared = rco.compare([CHAIN, CHAIN.system * 0.9], record)
    assert compared.best == 1
    sentences, fine = compared.answer()
    assert compared.names[1] in sentences[0]
    assert isinstance(fine, bool)
    assert rco.check(CHAIN, record, information=False).answer()[1] is True
    assert CHAIN.answer() == ([], True)
