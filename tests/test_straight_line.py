"""Functions of a nonlinear model as straight-line code: exact derivatives, and when there is none."""

import math
from functools import partial
from math import atan, sin

import control as ct
import numpy as np
import pytest
from inner import NUMBA, Engine, Structure
from numpy import array, cosh

import rcorefine as rco
from rcorefine.effects import expressions, right_hand_side

AT = np.array([0.3, 0.7, 0.2])


def helper(v):
    return math.tanh(v / 0.1) + atan(v)


def stand(t, x, u, p):
    scale = p.get("b", 2.0)

    def bent(value):
        return math.exp(-value) * scale

    rate = np.zeros(2)
    rate[0] = bent(float(x[1])) + helper(x[0])
    rate[1] = sin(x[0]) ** 2 + max(x[0], u[0], 0.0) + np.sqrt(np.maximum(x[1], 0.1))
    return rate


def whole(t, x, u, p):
    A = np.array([[0.0, 1.0], [-1.0, -0.1]])
    return A @ x + np.array([0.0, 1.0]) * u[0] - np.abs(x) * x * p["b"] + np.maximum(x, [0.0, 0.5])


def mixed(t, x, u, p):
    return [
        np.hypot(x[0], u[0]) + np.clip(u[0], -1.0, 0.1) + np.clip(x, 0.0, 0.5)[1],
        2.0 ** x[0] + x[1] ** -1 + x[1] ** 2.5 + np.sin(x)[0] * np.log10(x[1]) + np.sum(np.square(x)) - -x[0],
    ]


def fans(t, x, u, p):
    return np.array(
        [
            np.arctan(x[0]) + np.arcsin(x[0]) / np.cosh(x[1]) + np.log1p(u[0]) + np.deg2rad(x[1]),
            np.expm1(x[0])
            - np.arcsinh(x[1])
            + np.tan(x[0]) * np.arccos(u[0])
            + abs(x[0] - 1.0)
            + np.sinh(x[1])
            + math.atan2(x[0], x[1]) * np.arctan2(2.0, u[0]),
        ],
        dtype=float,
    )


class Plant:
    """A model as an object, whose functions are its methods."""

    stiffness = 3.0

    def rates(self, t, x, u, p):
        return np.array([x[1], math.tanh(float(u[0])) - self.stiffness * math.sin(x[0])])


def with_a_number(stiffness, t, x, u, p):
    return [x[1], u.item() - stiffness * math.sin(x[0])]


def by_arrays(t, x, u, p):
    """Entries that only the linear part moves are plain numbers when it is traced once more."""
    bent = (
        np.sin(x * [1.0, 0.0])
        + cosh(array([u[0], 0.1]))
        + np.abs(np.array([u[0], 1.0])) ** 3
        + np.tanh([x[1], 0.5])
    )
    return bent + np.maximum(np.array([x[1], 2.0]), 0.5)


@pytest.mark.parametrize(
    "function", [stand, whole, mixed, fans, Plant().rates, partial(with_a_number, 3.0), by_arrays]
)
def test_slopes_are_those_of_the_function(function):
    """Against differences of the function as it was written, Richardson's, good to 1e-9."""
    functions = right_hand_side.RightHandSide(function, None, ("b",), {}, 2, 0, "this")
    found = right_hand_side.exact_slopes(functions, AT, np.array([0.7]))

    def rates(z):
        return np.array(function(0.0, z[:2], z[2:], {"b": 0.7}), dtype=float)

    def central(h):
        return np.array([(rates(AT + h * e) - rates(AT - h * e)) / (2 * h) for e in np.eye(3)]).T

    np.testing.assert_allclose(found, (4 * central(5e-4) - central(1e-3)) / 3, rtol=1e-8, atol=1e-9)


def jumps(t, x, u, p):
    return np.array([x[1], u[0] - x[0] - np.sign(x[1])])


def branches(t, x, u, p):
    return np.array([x[1], u[0] - x[0] if x[1] > 0 else -x[0]])


def solves(t, x, u, p):
    return np.linalg.solve(np.array([[2.0 + np.cos(x[0]), 0.1], [0.1, 1.0]]), np.array([x[1], u[0] - x[0]]))


def counts(t, x, u, p):
    return np.array([x[1], u[0] - int(10 * x[0]) / 10])


def swallows(t, x, u, p):
    try:
        return np.array([x[1], u[0] - x[0] if x[0] < 9.0 else 0.0])
    except TypeError:
        return np.array([x[1], u[0]])


@pytest.mark.parametrize("function", [jumps, branches, solves, counts])
def test_what_hangs_on_values_is_no_straight_line(function):
    tape = expressions.Tape()
    x, u = np.array([tape.symbol("a"), tape.symbol("b")]), np.array([tape.symbol("u")])
    with pytest.raises(TypeError):
        expressions.as_numbers(expressions.tracing(function)(0.0, x, u, {}))


@pytest.mark.filterwarnings("ignore:.*called in Python:rcorefine.RCOWarning")
@pytest.mark.parametrize("function", [branches, solves, swallows])
def test_differences_stand_in_where_nothing_is_traced(function):
    """The field is the function less its linear part, whichever way it is computed."""
    known = rco.physical(ct.nlsys(function, None, states=2, inputs=1, outputs=2))
    known, point = known.linear, known.operating_point
    assert len(point.field.rows) == 4  # all
    for z in np.array([[0.2, 0.4, 0.1], [-0.3, -0.2, 0.5]]):
        rates = np.array(function(0.0, z[:2], z[2:], {}), dtype=float)
        wanted = rates - known.A @ z[:2] - known.B @ z[2:]
        np.testing.assert_allclose(point.field.table(point.field.nominal, z)[:2, 0], wanted, atol=1e-12)


def test_only_what_is_not_linear_is_left():
    """Ball and beam: one row is bent, one hangs on a parameter; the speed of the ball stands in neither."""

    def rates(t, x, u, p):
        return np.array([x[1], 5 / 7 * (x[0] * x[3] ** 2 - p["g"] * np.sin(x[2])), x[3], p["j"] * u[0]])

    model = ct.nlsys(
        rates, lambda t, x, u, p: x[[0, 2]], params={"g": 9.81, "j": 1.0},
        states=["r", "rdot", "th", "thdot"], inputs=["u"], outputs=["y", "theta"],
    )  # fmt: skip
    field = rco.physical(model).operating_point.field
    assert field.rows.tolist() == [1, 3]
    assert field.signals.tolist() == [0, 2, 3, 4]
    z = np.array([0.2, 0.1, 0.3, 0.4, 0.5])
    found = field.slopes(field.nominal, z)
    wanted = np.zeros((6, 5))
    wanted[1, [0, 2, 3]] = 5 / 7 * np.array([z[3] ** 2, 9.81 * (1 - np.cos(z[2])), 2 * z[0] * z[3]])
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_corners_have_a_slope():
    """A tank that has run dry: the root has none there, and a search goes on."""

    def drain(t, x, u, p):
        return np.array([u[0] - p["a"] * np.sqrt(np.maximum(x[0], 0.0))])

    model = ct.nlsys(drain, params={"a": 1.0}, states=["h"], inputs=["u"], outputs=["y"])
    tank = rco.physical(model, operating_point={"inputs": 1.0, "states": 1.0})
    field = tank.operating_point.field
    for level in (-1.0, -1.5):
        table = field.table(field.nominal, np.array([level]), 2.0)
        assert np.isfinite(table).all()
    data = rco.Measurement(np.zeros(200), np.zeros(200), dt=0.05)
    run = Engine(Structure(tank, [rco.Effect("model_parameter", "a")]), data, substeps=4).run(np.zeros(1))
    assert np.isfinite(run.outputs).all()
    assert np.isfinite(run.sensitivity).all()


def test_code_stays_small():
    """A sum in a loop is not written out beyond all bounds; the function is then called as it is."""

    def long(t, x, u, p):
        total = 0.0
        for k in range(30_000):
            total = total + np.sin(x[0] + k)
        return np.array([x[0] * 0.0 + total])

    tape = expressions.Tape()
    with pytest.raises(expressions.Untraceable, match="operations"):
        expressions.tracing(long)(0.0, np.array([tape.symbol("x")]), np.zeros(1), {})


@pytest.mark.skipif(not NUMBA, reason="nothing is compiled")
def test_functions_that_numba_refuses_are_compiled():
    def untyped(t, x, u, params):
        known = {name: params[name] for name in list(params)}
        return [x[1], u[0] - known["k"] * np.sin(x[0])]

    model = ct.nlsys(untyped, None, params={"k": 2.0}, states=2, inputs=1, outputs=2)
    assert rco.physical(model).operating_point.field.speed == "compiled"


def test_linear_functions_leave_nothing():
    """Simulated as the StateSpace that they are, with a law at it and without."""
    A, B = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.0], [1.0]])
    states = {"states": ["q", "v"], "inputs": ["f"], "outputs": ["y"]}
    bent = ct.nlsys(lambda t, x, u, p: A @ x + B @ u, lambda t, x, u, p: x[:1], **states)
    assert rco.physical(bent).operating_point.field.n_rows == 0
    w = np.sin(0.1 * np.arange(300.0))
    data = rco.Measurement(w, w, dt=0.05)
    models = bent, ct.ss(A, B, [[1.0, 0.0]], [[0.0]], **states)
    one, two = (rco.simulate(model, data, "zero").outputs for model in models)
    np.testing.assert_allclose(one, two, rtol=1e-10, atol=1e-12)
    law = [rco.Effect("cubic_stiffness", "q")]
    runs = [Engine(Structure(model, law), data, substeps=2).run(np.array([3.0])).outputs for model in models]
    np.testing.assert_allclose(*runs, rtol=1e-9, atol=1e-12)


def test_functions_of_whole_arrays():
    """A row that is linear is left out, and its state is a number when the others are traced."""

    def rates(t, x, u, p):
        return np.array([1.0, 0.0]) * x[1] + np.array([0.0, 1.0]) * (
            u[0] - np.sin(x) @ np.array([p["k"], 0.0])
        )

    model = ct.nlsys(rates, None, params={"k": 2.0}, states=2, inputs=1, outputs=2)
    field = rco.physical(model).operating_point.field
    assert (field.rows.tolist(), field.signals.tolist()) == ([1], [0])
