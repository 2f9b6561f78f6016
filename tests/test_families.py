"""Nested laws: what contains what, and that the simplest one that does is named."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_rivals import friction_record

import rcorefine as rco
from rcorefine.diagnosis.families import contains, hosts, merged
from rcorefine.effects import KINDS
from rcorefine.effects.along_motion import unit_forces

LIMITS = {"displacement": 1e-6, "velocity": 1e3, "softness": 0.1, "static_ratio": 1.0}
NESTED = [(law.name, inside) for law in KINDS.values() for inside in law.contains]


@pytest.mark.parametrize(("general", "special"), NESTED)
def test_a_law_contains_what_it_says(general, special):
    """Along any motion the force of the special case is one of the general law's."""
    t = np.linspace(0.0, 20.0, 4000)
    d = 0.3 * np.sin(2.1 * t) + 0.2 * np.sin(3.7 * t)
    v = np.append(0.0, np.diff(d)) / t[1]
    if "mechanical" not in KINDS[special].where:
        v = np.abs(v)  # a level
    law, shape = KINDS[general], dict(KINDS[general].contains[special])
    if special == "stiffness" and "displacement" in law.shaping:
        shape["displacement"] = 1e3  # so far that it never slips
    shape = {name: shape.get(name, LIMITS.get(name, 0.3)) for name in law.shaping}
    own = np.array(unit_forces(rco.Effect(general, "a"), d, v, [shape])).T
    same = {name: shape.get(name, LIMITS.get(name, 0.3)) for name in KINDS[special].shaping}
    wanted = np.sum(unit_forces(rco.Effect(special, "a"), d, v, [same]), axis=0)
    left = wanted - own @ np.linalg.lstsq(own, wanted, rcond=None)[0]
    moving = slice(200, None)  # from rest on
    assert np.linalg.norm(left[moving]) < 0.02 * np.linalg.norm(wanted[moving])


def test_what_contains_a_likelier_law_is_no_rival():
    def rival(kind, place="a"):
        return SimpleNamespace(effect=rco.Effect(kind, place))

    rivals = [
        rival(kind)
        for kind in ("quadratic_damping", "power_damping", "damping", "asymmetric_damping", "cubic_damping")
    ]
    assert contains(rivals[1].effect, rivals[4].effect)
    assert not contains(rivals[4].effect, rivals[1].effect)
    assert not contains(rivals[1].effect, rco.Effect("cubic_damping", "b"))
    held = hosts(rivals, range(5))
    assert held == {1: 0, 3: 2}
    np.testing.assert_allclose(merged(np.array([0.5, 0.2, 0.2, 0.06, 0.04]), held), [0.7, 0, 0.26, 0, 0.04])
    assert hosts(rivals[1:], range(4)) == {2: 1}  # the power law leads: it is likelier than what it contains


def test_the_simplest_law_that_does_is_named():
    model, data, _ = friction_record(12, 0.005)
    offered = [rco.Effect(f"{kind}_friction", "link1") for kind in ("asymmetric", "coulomb", "stribeck")]
    found = rco.diagnose(model, data, candidates=offered)
    assert found.verdict == "effect"
    assert found.best.effect.kind == "coulomb_friction"
    assert any("asymmetric_friction at link1 contains coulomb_friction" in note for note in found.notes)
    assert sum(row.probability for row in found.ranking) == pytest.approx(1.0)
    gain = {row.effect.kind: row.log_likelihood_gain for row in found.ranking}
    price = 0.5 * np.log(data.n_samples)
    assert gain["asymmetric_friction"] + price >= gain["coulomb_friction"] - 0.5
    assert gain["stribeck_friction"] + 2 * price >= gain["coulomb_friction"] - 0.5
