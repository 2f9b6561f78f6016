"""Rivals that are held to what their law says, and to a minimum that is one."""

from __future__ import annotations

import numpy as np
import pytest
from hidden.generator import Law, excitation, integrate, linear_states, outputs
from hidden.plants import PLANTS
from hidden.strong import servo_record

import rcorefine as rco


def friction_record(seed, width, *, samples=1500, noise=0.02):
    """A mass whose friction F tanh(v / v0) turns over slowly: v0 is `width` times the rms velocity."""
    rng = np.random.default_rng([seed, 83])
    plant = PLANTS["chain"](rng, 1, 1)
    place = plant.places[0]
    w = excitation(rng, plant, samples)
    v = place.v @ linear_states(plant, w)
    force = 0.3 * np.std(w)
    law = Law("coulomb_friction", np.array([force, width * np.std(v), 0.0]))
    x = integrate(plant, w, law, place)
    f = -law.p[0] * np.tanh(place.v @ x / law.p[1])
    y = outputs(plant, x, w, -f, place)
    y = y + noise * y.std() * rng.standard_normal(y.shape)
    return plant.model, rco.Measurement(w, y, dt=plant.dt, hold="foh"), force


@pytest.mark.filterwarnings("ignore::rcorefine.IdentifiabilityWarning")
@pytest.mark.parametrize("seed", [3, 4])
def test_static_friction_is_never_below_the_moving_one(seed):
    """A force that rises with speed asks for the opposite of Stribeck's law: it ends as plain friction."""
    model, data, _ = friction_record(seed, 0.6)
    better = rco.refine(model, data, [rco.Effect("stribeck_friction", "link1")])
    value = {row.name: row.value for row in better.parameters}
    assert value["static_force"] >= value["coulomb_force"]
    assert "At its bound" in better.message


def test_a_start_against_the_order_is_refused():
    with pytest.raises(rco.ModelError, match="at least as large"):
        rco.Effect("stribeck_friction", "link1", start={"coulomb_force": 2.0}, fixed={"static_force": 1.0})


def test_the_order_holds_beside_a_fixed_coefficient():
    model, data, force = friction_record(5, 0.6)
    floor = 0.9 * force
    effect = rco.Effect("stribeck_friction", "link1", fixed={"coulomb_force": floor})
    better = rco.refine(model, data, [effect])
    assert {row.name: row.value for row in better.parameters}["static_force"] >= floor


@pytest.mark.filterwarnings("ignore::rcorefine.IdentifiabilityWarning")
@pytest.mark.parametrize("seed", [21, 24])
def test_refine_of_a_diagnosis_ends_no_lower_than_the_ranking(seed):
    hidden = servo_record(seed, samples=2000)
    offered = [rco.Effect(kind, "angle") for kind in ("asymmetric_friction", "damping", "input_gain")]
    offered[2] = rco.Effect("input_gain", "voltage")
    found = rco.diagnose(hidden.plant.model, hidden.data, candidates=offered)
    assert np.mean(found.refine().fit) >= found.best.fit_after - 1e-6
