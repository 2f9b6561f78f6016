"""A sensor in series with a link reads its force, whatever is missing in it included."""

import control as ct
import numpy as np
import pytest
from cases import named
from inner import as_physical
from scipy.integrate import solve_ivp

import rcorefine as rco

M, C, K, DT = (1.2, 0.7), (1.1, 0.9), (160.0, 90.0), 0.02
NAMES = {"states": ["x1", "x2", "v1", "v2"], "inputs": ["F"], "outputs": ["cell", "pos"]}


def chain(where="link2", k=K):
    return rco.mass_spring_damper(
        M, C, k, force=2, sensors=[("force", where), ("displacement", 2)], inputs="F", outputs=["cell", "pos"]
    )


def plain(where="link2", **kwargs):
    s = chain(where).system
    return ct.ss(s.A, s.B, s.C, s.D, **kwargs)


def record(rng, k=K, law=lambda d, v: 0.0, beside=lambda v: 0.0, where=1, n=400):
    """Two links; `law` in the one with the cell, `beside` between mass 1 and the ground."""
    w = 4 * np.repeat(rng.choice([-1.0, 1.0], n // 20), 20)

    def forces(x):
        d, v = np.array([x[0], x[1] - x[0]]), np.array([x[2], x[3] - x[2]])
        f = np.array(k) * d + np.array(C) * v
        f[where] += law(d[where], v[where])
        return f

    def rates(t, x, u):
        f = forces(x)
        return [x[2], x[3], (f[1] - f[0] - beside(x[2])) / M[0], (u - f[1]) / M[1]]

    x, y = np.zeros(4), []
    for u in w:
        y.append((forces(x)[where], x[1]))
        x = solve_ivp(rates, (0, DT), x, args=(u,), rtol=1e-8, atol=1e-10).y[:, -1]
    y = np.array(y).T
    noisy = y + 0.01 * y.std(axis=1, keepdims=True) * rng.normal(size=y.shape)
    return rco.Measurement(w, noisy, dt=DT, input_labels="F", output_labels=["cell", "pos"])


@pytest.mark.parametrize("make", [chain, lambda: plain(**NAMES), plain], ids=["built", "plain", "anonymous"])
def test_a_spring_law_in_a_metered_link_is_read_by_its_cell(make, rng):
    model = make()
    data = record(rng, law=lambda d, v: 4e3 * d**3)
    link = next(p for p in as_physical(model).ports if p.output.any())
    effect = rco.Effect("cubic_stiffness", link.name)
    row = rco.refine(model, data, [effect]).parameter("cubic_stiffness")
    assert abs(row.value - 4e3) < 4 * row.std < 400
    found = rco.diagnose(model, data)
    named(found, effect, 4e3)


def test_the_spring_of_a_cell_itself_is_off(rng):
    data = record(rng, k=(K[0], 1.15 * K[1]))
    for model, place in ((chain(), "link2"), (plain(**NAMES), "x1-x2")):
        found = rco.diagnose(model, data)
        named(found, rco.Effect("stiffness", place), 0.15 * K[1])


@pytest.mark.parametrize("beside", [True, False])
def test_friction_beside_a_cell_and_in_it_are_two_things(beside, rng):
    def dry(v):
        return 0.5 * np.tanh(v / 0.002)

    kind = {"beside": dry} if beside else {"law": lambda d, v: dry(v)}
    data = record(rng, where=0, **kind)
    at = {"x1": True, "x1 (cell)": False}
    found = rco.diagnose(plain("link1", **NAMES), data)
    places = {effect.place for effect in (*found.ambiguous, *found.effects)}
    assert {at[place] for place in places} == {beside}
    for place in places:
        if rco.Effect("coulomb_friction", place) in (*found.ambiguous, *found.effects):
            named(found, rco.Effect("coulomb_friction", place), 0.5, share=0.02)


def test_two_cells_of_one_support_read_one_force():
    """The second, which reads twice as much with the other sign, is no place of its own."""
    s = plain("link1")
    twice = ct.ss(s.A, s.B, s.C[[0, 0, 1]] * [[1.0], [-2.0], [1.0]], 0, states=NAMES["states"], inputs=["F"],
                  outputs=["cell", "other", "pos"])  # fmt: skip
    (port,) = (p for p in as_physical(twice).ports if p.output.any())
    assert port.name == "x1 (cell)"
    np.testing.assert_allclose(port.output, [1.0, -2.0, 0.0])


def test_a_shunt_whose_resistance_stands_in_C_comes_home(rng):
    def shunt(R):
        A = [[-300.0, -100.0, 0.0], [5000.0, 0.0, -5000.0], [0.0, 50.0, -50.0 * R]]
        return ct.ss(A, [[100.0], [0], [0]], [[0, 0, R]], 0, states=["i1", "v", "i2"], inputs=["U"],
                     outputs=["load"])  # fmt: skip

    w = 12 * np.repeat(rng.choice([-1.0, 1.0], 60), 25)
    y = ct.forced_response(shunt(9.5).sample(4e-4), inputs=w).outputs
    data = rco.Measurement(w, y + 0.01 * y.std() * rng.normal(size=y.size), dt=4e-4, input_labels=["U"],
                           output_labels=["load"])  # fmt: skip
    assert rco.Effect("damping", "i2 (load)") in rco.effect_library(shunt(8.0))
    row = rco.refine(shunt(8.0), data, free=[rco.Effect("damping", "i2 (load)")]).parameter("c[i2]")
    assert abs(row.value - 9.5) < 4 * row.std < 0.2
    assert rco.compare(rco.refine(shunt(8.0), data, free="linear"), data).fit[0] > 98.9


@pytest.mark.parametrize(
    "system",
    [
        ct.ss([[-2.0]], [[1.0]], [[2.0]], 0),  # unit gain by one number
        ct.ss([[-3.0, -40.0], [1.0, 0.0]], [[1.0], [0.0]], [[3.0, 40.0]], 0),  # the same of a loop
        ct.ss([[0, 1], [-100.0, 0]], [[0], [1.0]], [[100.0, 0]], 0, states=["x", "v"]),  # percent
        ct.ss([[0, 1], [-40.0, -3.0]], [[0], [2.0]], [[-40.0, -3.0]], [[2.0]], states=["x", "v"]),
        # a resonator of 2 ug at 20 kHz, quality 60, by its displacement: 4e-6 N s/m beside 32 N/m is no zero
        ct.ss([[0, 1], [-1.58e10, -2094.0]], [[0], [5e8]], [[1.0, 0]], 0, states=["x", "v"]),
    ],
)
def test_what_could_as_well_be_a_gain_or_an_accelerometer_is_no_load_cell(system):
    assert not any(port.output.any() for port in as_physical(system).ports)


def test_a_cell_where_nothing_holds_is_refused():
    with pytest.raises(rco.ModelError, match="no spring or damper is known there; they are at link1, link2"):
        rco.mass_spring_damper(M, C, K, sensors=("force", "mass1"))
