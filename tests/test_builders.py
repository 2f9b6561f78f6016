"""Builders against independent derivations: by hand, Lagrange, closed-form transfer functions."""

import pickle
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy.linalg import eigh

import rcorefine as rco

OMEGA = np.geomspace(1e-2, 1e3, 25)
S = 1j * OMEGA


def response(model, omega=OMEGA):
    """G(jw) of shape (n_y, n_w, n_omega), by solving at each frequency."""
    sys = getattr(model, "system", model)
    eye = np.eye(sys.nstates)
    return np.stack(
        [sys.C @ np.linalg.solve(1j * w * eye - sys.A, sys.B.astype(complex)) + sys.D for w in omega], axis=-1
    )


def with_parameter(model, name, change):
    """A, B, C, D when a parameter changes, through its port: the algebra that the engine solves."""
    item = next(item for item in model.parameters if item.name == name)
    port, linear = model.port(item.place), model.linear
    A, B, inertia = linear.A.copy(), linear.B.copy(), np.eye(linear.n_states)
    if item.kind == "stiffness":
        A += change * np.outer(port.act, port.position)
        B += change * np.outer(port.act, port.position_input)
    elif item.kind == "damping":
        A += change * np.outer(port.act, port.velocity)
        B += change * np.outer(port.act, port.velocity_input)
    else:  # dx/dt = A x + B w + act t (velocity dx/dt + acceleration_input w)
        inertia -= change * np.outer(port.act, port.velocity)
        B += change * np.outer(port.act, port.acceleration_input)
    A, B = np.linalg.solve(inertia, A), np.linalg.solve(inertia, B)
    C, D = model.output_state + model.output_rate @ A, model.output_input + model.output_rate @ B
    if port.output.size:  # y = ... + output f, with f = k d, c v, m a
        sense = {"stiffness": port.position, "damping": port.velocity, "mass": port.velocity @ A}
        of_inputs = {
            "stiffness": port.position_input,
            "damping": port.velocity_input,
            "mass": port.velocity @ B + port.acceleration_input,
        }
        C = C + change * np.outer(port.output, sense[item.kind])
        D = D + change * np.outer(port.output, of_inputs[item.kind])
    return ct.ss(A, B, C, D)


# ---------------------------------------------------------------- each parameter, through its place
def chain_of(p):
    return rco.mass_spring_damper(
        [p["m1"], p["m2"], p["m3"]],
        [p["c1"], p["c2"], p["c3"], p["c4"]],
        [p["k1"], p["k2"], p["k3"], p["k4"]],
        force=[1, 3],
        sensors=["displacement", ("velocity", 2), ("acceleration", (1, 3)), ("displacement", "link2")],
    )


def shaken_of(p):
    return rco.mass_spring_damper(
        [p["m1"], p["m2"]],
        [p["c1"], p["c2"]],
        [p["k1"], p["k2"]],
        excitation="base",
        sensors=["acceleration", ("velocity", 1)],
    )


def general_of(p):
    K = [[p["k1"] + p["k12"], -p["k12"]], [-p["k12"], p["k12"] + p["k2"]]]
    C = [[p["c1"] + p["c12"], -p["c12"]], [-p["c12"], p["c12"] + p["c2"]]]
    return rco.mechanical([p["m1"], p["m2"]], C, K, sensors=["acceleration", "velocity"])


def car_of(p):
    return rco.quarter_car(
        p["body_mass"],
        p["wheel_mass"],
        p["suspension_stiffness"],
        p["suspension_damping"],
        p["tire_stiffness"],
        p["tire_damping"],
        actuator=True,
        sensors=["body_acceleration", "wheel_acceleration", "suspension_deflection", "tire_deflection"],
    )


def raised_of(p):
    return rco.quarter_car(
        p["body_mass"],
        p["wheel_mass"],
        p["suspension_stiffness"],
        p["suspension_damping"],
        p["tire_stiffness"],
        road="displacement",
        sensors=["body_position", "tire_deflection", "wheel_acceleration"],
    )


CHAIN = {f"{x}{i}": v for x, vs in {"m": (1.0, 2, 3), "c": (1, 2, 3, 4), "k": (50, 60, 70, 80)}.items()
         for i, v in enumerate(vs, 1)}  # fmt: skip
CAR = {
    "body_mass": 250.0, "wheel_mass": 35.0, "suspension_stiffness": 16e3, "suspension_damping": 1e3,
    "tire_stiffness": 160e3, "tire_damping": 80.0,
}  # fmt: skip
CASES = {
    "chain": (chain_of, CHAIN, {}),
    "shaken": (shaken_of, {"m1": 1.0, "m2": 2.0, "c1": 1, "c2": 2, "k1": 30, "k2": 40}, {}),
    "general": (
        general_of,
        {"m1": 1.0, "m2": 2.0, "c1": 1, "c12": 2, "c2": 3, "k1": 30, "k12": 40, "k2": 50},
        {"c1": "c[mass1]", "c12": "c[mass1-mass2]", "c2": "c[mass2]", "k1": "k[mass1]",
         "k12": "k[mass1-mass2]", "k2": "k[mass2]"},
    ),
    "rlc": (
        lambda p: rco.series_rlc(
            p["R"], p["L"], 1 / p["1/C"],
            sensors=["current", "charge", "resistor_voltage", "capacitor_voltage", "inductor_voltage"],
        ),
        {"R": 250.0, "L": 0.055, "1/C": 4e4},
        {},
    ),
    "motor": (
        lambda p: rco.dc_motor(
            R=p["R"], L=p["L"], Kt=0.1, J=p["J"], b=p["b"], load_torque=True,
            sensors=["speed", "angle", "current"],
        ),
        {"R": 1.5, "L": 0.2, "J": 0.01, "b": 0.02},
        {},
    ),
    "speed": (
        lambda p: rco.dc_motor(gain=1 / p["1/gain"], time_constant=p["tau/gain"] / p["1/gain"]),
        {"1/gain": 0.5, "tau/gain": 0.2},
        {},
    ),
    "thermal": (
        lambda p: rco.thermal_network(
            [p["C1"], p["C2"], p["C3"]], {(1, 2): 1 / p["G12"], (2, 3): 1 / p["G23"], (3, 0): 1 / p["G3"]},
            heat=[1, 2],
        ),
        {"C1": 1.0, "C2": 2.0, "C3": 5.0, "G12": 2.0, "G23": 3.0, "G3": 0.5},
        {"C1": "C[T1]", "C2": "C[T2]", "C3": "C[T3]", "G12": "1/R[T1-T2]", "G23": "1/R[T2-T3]",
         "G3": "1/R[T3-ambient]"},
    ),
    "tanks": (
        lambda p: rco.two_tanks([p["A1"], p["A2"]], [p["k1"], p["k2"]], pump_gain=3.0, sensors=[1, 2]),
        {"A1": 2.0, "A2": 1.0, "k1": 0.5, "k2": 0.25},
        {},
    ),
    "car": (car_of, CAR, {}),
    "raised": (raised_of, {key: value for key, value in CAR.items() if key != "tire_damping"}, {}),
}  # fmt: skip


@pytest.mark.parametrize(
    "case, name", [(case, name) for case, (_, values, _) in CASES.items() for name in values]
)
def test_changing_a_parameter_is_an_effect_at_its_place(case, name):
    """The port of each parameter gives the model that is built with the changed value."""
    build, values, names = CASES[case]
    model = build(values)
    shown = names.get(name, name)
    item = next(item for item in model.parameters if item.name == shown)
    assert item.value == pytest.approx(values[name])
    changed = build(values | {name: 1.7 * values[name]})
    through_port = with_parameter(model, shown, 0.7 * values[name])
    np.testing.assert_allclose(response(through_port), response(changed), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("case", CASES)
def test_pickle_text_and_library_of_each(case):
    build, values, _ = CASES[case]
    model = build(values)
    again = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(again.system.B, model.system.B)
    assert again.parameters == model.parameters
    assert max(map(len, str(model).splitlines())) <= 80
    assert all(unit for unit in model.state_units + model.input_units + model.output_units)
    assert all(port.force_unit and port.velocity_unit and port.description for port in model.ports)
    for effect in rco.effect_library(model):
        model.check(effect)
        for coefficient in effect.coefficients:
            assert model.unit(effect, coefficient), (effect, coefficient)


# ---------------------------------------------------------------- transfer functions by hand
def spring(m=2.0, c=0.7, k=30.0):
    G = 1 / (m * S**2 + c * S + k)
    sensors = ["displacement", "velocity", "acceleration"]
    return rco.mass_spring_damper(m, c, k, sensors=sensors), [[G], [S * G], [S**2 * G]]


def rotor():
    """Gyroscopic coupling of two directions."""
    C, K = np.array([[0, 3.0], [-3.0, 0]]), np.diag([4.0, 9.0])
    model = rco.mechanical(np.eye(2), C, K, force_map=2, sensors=("displacement", 1))
    return model, [[-3 * S / ((S**2 + 4) * (S**2 + 9) + 9 * S**2)]]


def divider(R=250.0, L=55e-3, C=23.5e-6):
    names = ["resistor_voltage", "inductor_voltage", "capacitor_voltage", "current", "charge"]
    Z = R + L * S + 1 / (C * S)
    gains = [R / Z, L * S / Z, 1 / (C * S) / Z, 1 / Z, 1 / Z / S]
    return rco.series_rlc(R, L, C, sensors=names), [[gain] for gain in gains]


def motor(R=1.5, L=0.02, Kt=0.1, Ke=0.12, J=0.01, b=0.003):
    sensors, parts = ["angle", "speed", "current"], {"R": R, "L": L, "Kt": Kt, "Ke": Ke, "J": J, "b": b}
    D = (L * S + R) * (J * S + b) + Kt * Ke
    turned, held = Kt / D, -(L * S + R) / D
    expected = [[turned / S, held / S], [turned, held], [(J * S + b) / D, Ke / D]]
    return rco.dc_motor(**parts, load_torque=True, sensors=sensors), expected


def cascade(A1=2.0, A2=1.0, k1=0.5, k2=0.25, gain=3.0):
    model = rco.two_tanks((A1, A2), (k1, k2), pump_gain=gain)
    return model, [[gain * k1 / ((A1 * S + k1) * (A2 * S + k2))]]


def cooling():
    """Relative to constant surroundings."""
    return rco.thermal_network(4.0, {(1, 0): 0.5}, ambient_input=False), [[1 / (4 * S + 2)]]


@pytest.mark.parametrize(
    "case, rtol, atol",
    [
        (spring, 1e-9, 1e-14), (divider, 1e-9, 1e-14), (rotor, 1e-9, 0), (motor, 1e-8, 0),
        (cascade, 1e-12, 0), (cooling, 1e-12, 0),
    ],
)  # fmt: skip
def test_closed_form(case, rtol, atol):
    model, expected = case()
    np.testing.assert_allclose(response(model), expected, rtol=rtol, atol=atol)


# ---------------------------------------------------------------- chains
class TestChain:
    def test_matrices_of_the_paper(self):
        model = rco.mass_spring_damper(
            [0.8, 0.5], [100, 200, 120], [1000, 25000, 25000], sensors=("velocity", 1), outputs="y"
        )
        M = np.diag([0.8, 0.5])
        C = [[300, -200], [-200, 320]]
        K = [[26000, -25000], [-25000, 50000]]
        np.testing.assert_allclose(model.system.A[2:, :2], -np.linalg.solve(M, K))
        np.testing.assert_allclose(model.system.A[2:, 2:], -np.linalg.solve(M, C))
        np.testing.assert_allclose(model.system.B, [[0], [0], [1 / 0.8], [0]])
        assert model.system.output_labels == ["y"]

    def test_transmissibility_closed_form(self):
        m, c, k = 200.0, 15000.0, 63500.0
        model = rco.mass_spring_damper(m, c, k, excitation="base", sensors="acceleration")
        np.testing.assert_allclose(response(model)[0, 0], (c * S + k) / (m * S**2 + c * S + k), rtol=1e-10)
        np.testing.assert_allclose(model.system.B, [[0], [-1]])
        np.testing.assert_allclose(model.system.D, [[0]], atol=1e-15)

    def test_free_and_fixed_end_by_lagrange(self, rng):
        n = 5
        m, c = rng.uniform(1, 3, n), rng.uniform(0.1, 1, n + 1)
        k = rng.uniform(10, 90, n)  # n springs, n+1 dampers: the end has a damper only
        model = rco.mass_spring_damper(m, c, k, force=[2, 4], sensors="displacement")

        def energy_hessian(values):  # of V = 1/2 sum k_i (q_i - q_(i-1))^2, by the definition
            def V(q):
                padded = np.concatenate([[0.0], q, [0.0]])
                return 0.5 * sum(v * (padded[i + 1] - padded[i]) ** 2 for i, v in enumerate(values))

            e = np.eye(n)
            return np.array([[V(e[i] + e[j]) - V(e[i]) - V(e[j]) for j in range(n)] for i in range(n)])

        K, C = energy_hessian(k), energy_hessian(c)
        F = np.eye(n)[:, [1, 3]]
        expected = np.stack([np.linalg.solve(-np.diag(m) * w**2 + 1j * w * C + K, F) for w in OMEGA], axis=-1)
        np.testing.assert_allclose(response(model), expected, rtol=1e-9, atol=1e-14)
        assert [port.name for port in model.ports][:6] == [f"link{i}" for i in range(1, 7)]
        assert model.system.input_labels == ["force2", "force4"]

    def test_base_excitation_in_absolute_coordinates(self):
        m, c, k = np.array([1.0, 2.0]), np.array([0.3, 0.2]), np.array([40.0, 60.0])
        model = rco.mass_spring_damper(
            m, c, k, excitation="base", force=2, sensors=["acceleration", ("displacement", 2)]
        )
        # absolute z with z0 the base: M z'' + C z' + K z = (c1 z0' + k1 z0) e1
        C = np.array([[c.sum(), -c[1]], [-c[1], c[1]]])
        K = np.array([[k.sum(), -k[1]], [-k[1], k[1]]])
        for i, w in enumerate(OMEGA):
            s = 1j * w
            Z = np.linalg.inv(np.diag(m) * s**2 + C * s + K)
            z = Z @ np.array([c[0] * s + k[0], 0]) / s**2  # per unit base acceleration
            G = response(model, [w])[:, :, 0]
            np.testing.assert_allclose(G[:2, 0], s**2 * z, rtol=1e-8)
            np.testing.assert_allclose(G[2, 0], z[1] - 1 / s**2, rtol=1e-6)
            np.testing.assert_allclose(G[:2, 1], s**2 * Z[:, 1], rtol=1e-8, err_msg=str(i))

    def test_sensors_in_order_with_labels(self):
        model = rco.mass_spring_damper(
            [1, 1, 1], [1, 1, 1], [1, 1, 1], sensors=[("velocity", 1), ("acceleration", 3)]
        )
        assert model.linear.output_labels == ("v1", "a3")
        assert model.output_units == ("m/s", "m/s^2")
        np.testing.assert_array_equal(model.output_rate, [[0] * 6, [0, 0, 0, 0, 0, 1]])

    def test_force_map(self):
        model = rco.mass_spring_damper([1, 2], [1, 1], [1, 1], force=np.array([[1.0], [-3.0]]))
        np.testing.assert_allclose(model.system.B, [[0], [0], [1], [-1.5]])


# ---------------------------------------------------------------- general matrices
class TestMechanical:
    def test_agrees_with_the_chain(self):
        chain = rco.mass_spring_damper([1, 2, 3], [0.1, 0.2, 0.3], [10, 20, 30], sensors=("velocity", 3))
        K = [[30, -20, 0], [-20, 50, -30], [0, -30, 30.0]]
        C = 0.01 * np.array(K)
        model = rco.mechanical([1, 2, 3], C, K, sensors=("velocity", 3))
        np.testing.assert_allclose(response(model), response(chain), rtol=1e-10)
        assert [port.name for port in model.ports][:2] == ["mass1-mass2", "mass2-mass3"]

    def test_full_mass_matrix_by_virtual_work(self, rng):
        # a force pair at a link of a model with inertial coupling: K changes by t g g'
        Q = rng.normal(size=(4, 4))
        M, K = Q @ Q.T + 4 * np.eye(4), np.diag([5.0, 6, 7, 8])
        g = rng.normal(size=4)
        model = rco.mechanical(
            M, K=K, links={"brace": g, "strut": (1, 4), "foot": (2, 0)}, damping_ratio=0.01
        )
        for name, direction in (("brace", g), ("strut", np.array([1.0, 0, 0, -1]))):
            port = model.port(name)
            changed = model.linear.A + 3.0 * np.outer(port.act, port.position)
            expected = -np.linalg.solve(M, K + 3.0 * np.outer(direction, direction))
            np.testing.assert_allclose(changed[4:, :4], expected, rtol=1e-10)
        assert {item.place for item in model.parameters if item.kind == "stiffness"} >= {"foot"}

    def test_modal_damping_ratios(self, rng):
        Q = rng.normal(size=(5, 5))
        M, K = np.diag(rng.uniform(1, 2, 5)), Q @ Q.T + np.eye(5)
        ratios = np.array([0.01, 0.02, 0.03, 0.04, 0.05])
        poles = np.linalg.eigvals(rco.mechanical(M, K=K, damping_ratio=ratios).system.A)
        poles = poles[poles.imag > 0]
        poles = poles[np.argsort(np.abs(poles))]
        np.testing.assert_allclose(np.abs(poles), np.sqrt(eigh(K, M, eigvals_only=True)), rtol=1e-9)
        np.testing.assert_allclose(-poles.real / np.abs(poles), ratios, rtol=1e-8)


# ---------------------------------------------------------------- circuits, motors, heat, tanks, car
class TestElectrical:
    def test_stiff_start_of_the_paper(self):
        model = rco.series_rlc(250.0, 2e-6, 1.0)
        np.testing.assert_allclose(model.system.A, [[0, 1], [-5e5, -1.25e8]])
        np.testing.assert_allclose(model.system.C, [[0, 250]])


class TestMotor:
    def test_speed_model(self):
        model = rco.dc_motor(gain=35.0, time_constant=0.28)
        np.testing.assert_allclose(response(model)[0, 0], 35 / (0.28 * S + 1), rtol=1e-12)
        assert model.port("shaft").force_unit == "V"

    def test_reversed_motor_is_still_braked_by_friction(self):
        port = rco.dc_motor(gain=-35.0, time_constant=0.28).port("shaft")
        assert port.act[0] < 0 < port.velocity[0]


class TestThermal:
    def test_nodal_admittances(self):
        C = np.array([10.0, 20.0, 5.0])
        R12, R23, R30, R10 = 0.5, 2.0, 4.0, 8.0
        model = rco.thermal_network(C, {(1, 2): R12, (3, 2): R23, (3, 0): R30, (0, 1): R10}, heat=[1, 3])
        G = np.diag([1 / R12 + 1 / R10, 1 / R12 + 1 / R23, 1 / R23 + 1 / R30])
        G[0, 1] = G[1, 0] = -1 / R12
        G[1, 2] = G[2, 1] = -1 / R23
        F = np.array([[1, 0, 1 / R10], [0, 0, 0], [0, 1, 1 / R30]])
        expected = np.stack([np.linalg.solve(1j * w * np.diag(C) + G, F) for w in OMEGA], axis=-1)
        np.testing.assert_allclose(response(model), expected, rtol=1e-9)

    def test_steady_state_follows_the_surroundings(self):
        model = rco.thermal_network([1.0, 2.0], {(1, 2): 1.0, (2, 0): 1.0}, states=["room", "wall"])
        np.testing.assert_allclose(ct.dcgain(model.system)[:, 1], [1, 1])
        assert [port.name for port in model.ports] == ["room", "wall", "room-wall", "wall-ambient"]


class TestTanks:
    def test_flow_between_conserves_volume(self):
        areas = np.array([2.0, 5.0])
        model = rco.two_tanks(areas, (1.0, 1.0))
        assert areas @ model.port("tank1->tank2").act == pytest.approx(0.0)
        assert areas @ model.port("tank1").act == pytest.approx(-1.0)


class TestCar:
    def test_closed_form_both_inputs(self):
        mb, mw, ks, cs, kt, cd = 250.0, 35.0, 16e3, 1e3, 160e3, 80.0
        sensors = ["body_velocity", "wheel_velocity", "suspension_deflection", "tire_deflection",
                   "body_acceleration"]  # fmt: skip
        model = rco.quarter_car(mb, mw, ks, cs, kt, cd, actuator=True, sensors=sensors)
        for i, w in enumerate(OMEGA):
            s = 1j * w
            M = np.array(
                [[mb * s**2 + cs * s + ks, -cs * s - ks], [-cs * s - ks, mw * s**2 + (cs + cd) * s + ks + kt]]
            )
            z = np.linalg.solve(M, np.array([[0, 1], [(cd * s + kt) / s, -1]]))  # road enters as velocity
            road = np.array([1 / s, 0])
            expected = [s * z[0], s * z[1], z[0] - z[1], z[1] - road, s**2 * z[0]]
            np.testing.assert_allclose(
                response(model, [w])[:, :, 0], expected, rtol=1e-6, atol=1e-9, err_msg=str(i)
            )

    def test_height_of_the_road_as_input(self):
        velocity = rco.quarter_car(250.0, 35.0, 16e3, 1e3, 160e3, sensors="body_acceleration")
        height = rco.quarter_car(
            250.0, 35.0, 16e3, 1e3, 160e3, sensors="body_acceleration", road="displacement"
        )
        np.testing.assert_allclose(
            response(height)[0, 0], response(velocity)[0, 0] * 1j * OMEGA, rtol=1e-7, atol=1e-9
        )
        assert not height.port("tire").has_velocity


# ---------------------------------------------------------------- what is wrong is said
TWO, TWICE = ([1, 2], [1, 1], [1, 1]), np.eye(2)
WRONG = {
    rco.mass_spring_damper: [
        (([1, -2], [1, 1], [1, 1]), {}, r"m\[1\] = -2 must be positive"),
        (([1, 2], [1, 1], [1, -1]), {}, r"k\[1\] = -1 must not be negative"),
        (([1, 2], [1, np.nan], [1, 1]), {}, r"c\[1\]"),
        (([1, 2], [1, 1], [1]), {}, "k has 1 entries for 2 masses"),
        (([1, 2], [1, 1, 1, 1], [1, 1]), {}, "c has 4 entries"),
        ((["a", 2], [1, 1], [1, 1]), {}, "m must hold real numbers"),
        (TWO, {"force": 3}, "= 3 does not exist"),
        (TWO, {"force": [1, 1]}, "names a mass twice"),
        (TWO, {"force": 1.0}, "whole number"),
        (TWO, {"sensors": ("speed", 1)}, "'displacement', 'velocity'"),
        (TWO, {"sensors": ("velocity", 5)}, "= 5 does not exist"),
        (TWO, {"sensors": ("velocity", "link9")}, "no such place"),
        (TWO, {"sensors": ["velocity", ("velocity", 1)]}, "more than once"),
        (TWO, {"sensors": []}, "empty"),
        (TWO, {"sensors": 3}, "must be a quantity"),
        (TWO, {"outputs": "y"}, "1 names for 2"),
        (TWO, {"outputs": ["y", "y"]}, "unique"),
        (TWO, {"excitation": "road"}, "'force', 'base'"),
        (TWO, {"stiffness": 3}, "unexpected keyword"),
    ],
    rco.mechanical: [
        (([[1, 2], [2, 1]],), {"K": TWICE}, "positive definite"),
        (([[1, 2], [0, 1]],), {"K": TWICE}, "M is not symmetric"),
        (([1, 1],), {"K": [[1, -1], [0, 1]]}, "K is not symmetric"),
        (([1, 1],), {"K": np.eye(3)}, r"K has shape \(3, 3\)"),
        (([1, 1],), {"K": TWICE, "C": TWICE, "damping_ratio": 0.1}, "not both"),
        (([1, 1],), {"K": -TWICE, "damping_ratio": 0.1}, "negative direction"),
        (([1, 1],), {"K": TWICE, "links": {"a": (1, 2), "b": (2, 1)}}, "join the same"),
        (([1, 1],), {"K": TWICE, "links": {"a": (0, 1)}}, "start at a mass"),
        (([1, 1],), {"K": TWICE, "links": {"mass1": (1, 2)}}, "cannot be named"),
        (([1, 1],), {"K": TWICE, "links": {"a": np.ones(3)}}, "length 2"),
        (([1, 1],), {"K": TWICE, "force_map": np.ones((3, 1))}, "3 rows for 2"),
        (([1, 1],), {"K": TWICE, "force_map": np.zeros((2, 1))}, "acts on no mass"),
    ],
    rco.series_rlc: [
        ((1.0, 0.0, 1.0), {}, "L = 0 must be positive"),
        ((1.0, 1.0, 1.0), {"sensors": "power"}, "resistor_voltage"),
    ],
    rco.dc_motor: [
        ((), {}, "R, L, Kt, J missing"),
        ((), {"gain": 2.0}, "both gain and time_constant"),
        ((), {"gain": 2.0, "time_constant": 1.0, "R": 1.0}, "not both"),
        ((), {"gain": 2.0, "time_constant": -1.0}, "time_constant = -1"),
        ((), {"gain": 0.0, "time_constant": 1.0}, "gain = 0"),
        ((), {"gain": 2.0, "time_constant": 1.0, "sensors": "current"}, "'speed', 'angle'"),
        ((), {"gain": 2.0, "time_constant": 1.0, "load_torque": True}, "electromechanical"),
        ((), {"R": 1.0, "L": 1.0, "Kt": 1.0}, "J missing"),
    ],
    rco.thermal_network: [
        (([1.0, 2.0], {(1, 3): 1.0}), {}, "= 3 does not exist"),
        (([1.0, 2.0], {(1, 1): 1.0}), {}, "joins a node to itself"),
        (([1.0, 2.0], {(1, 2): 1.0, (2, 1): 2.0}), {}, "joined already"),
        (([1.0, 2.0], {(1, 2): 0.0}), {}, "must be positive"),
        (([1.0, 2.0], {}), {}, "must be a mapping"),
        (([1.0, 2.0], {(1, 2): 1.0}), {"heat": ()}, "no input"),
        (([1.0, 2.0], {(1, 2): 1.0}), {"sensors": [1, 1]}, "each once"),
        (([1.0], {(1, 0): 1.0}), {"states": ["ambient"]}, "named like the inputs"),
    ],
    rco.two_tanks: [(((1, 2, 3),), {}, "areas has 3 entries"), ((), {"sensors": 3}, "= 3 does not exist")],
    rco.quarter_car: [
        ((250.0, 35.0, 16e3, 1e3, 160e3, 10.0), {"road": "displacement"}, "tire_damping needs"),
    ],
}


@pytest.mark.parametrize(
    "build, arguments, keywords, message",
    [(build, *case) for build, cases in WRONG.items() for case in cases],
)
def test_what_is_wrong_is_said(build, arguments, keywords, message):
    with pytest.raises((rco.ModelError, ct.ControlDimension, ct.ControlArgument, TypeError), match=message):
        build(*arguments, **keywords)


def test_ports_of_builders_agree_with_those_found():
    """What is read out of the matrices is what the builder put in."""
    model = rco.mass_spring_damper([1, 2], [0.1, 0.2, 0.3], [10, 20, 30], states=["x1", "x2", "v1", "v2"])
    found = rco.PhysicalModel.from_statespace(model.system)
    for ours, theirs, sign in (("link1", "x1", 1), ("link3", "x2", 1), ("link2", "x1-x2", -1)):
        np.testing.assert_allclose(model.port(ours).act, sign * found.port(theirs).act)
        np.testing.assert_allclose(model.port(ours).position, sign * found.port(theirs).position)
    np.testing.assert_array_equal(found.output_rate, model.output_rate)


def test_port_can_be_renamed():
    model = rco.series_rlc(1.0, 1.0, 1.0)
    renamed = replace(model, ports=(replace(model.ports[0], name="coil"),), parameters=())
    assert renamed.port("coil").kind == "mechanical"


class TestForceMap:
    """F of M q'' + K q = F w, by its own name and with the unit that is known."""

    def test_rows_in_lists_are_a_matrix(self):
        for F in ([[0.245]], ((0.245,),), np.array([[0.245]])):
            model = rco.mechanical([[2.0]], K=[[10.0]], force_map=F, inputs="volt", force_unit="N m")
            assert model.system.B[1, 0] == 0.245 / 2.0
            assert model.input_units == ("",)

    def test_the_unit_of_a_force_is_known(self):
        for F in (1, [1, 2], np.eye(2), [[1, 0], [-1, 1]]):
            model = rco.mechanical([1.0, 1.0], K=np.eye(2), force_map=F, force_unit="N m")
            assert set(model.input_units) == {"N m"}
        mixed = rco.mechanical([1.0, 1.0], K=np.eye(2), force_map=[[1.0, 0.3], [0.0, 1.0]])
        assert mixed.input_units == ("N", "")
        assert rco.mass_spring_damper(1.0, 1.0, 1.0, force=[[0.5]]).input_units == ("",)

    @pytest.mark.parametrize("F", [[0.245], 0.245, [3], [[1.0, 2.0]], [[0.0], [0.0]], [[1.0], [1.0, 2.0]]])
    def test_its_own_name_is_in_the_error(self, F):
        wrong = (rco.ModelError, ct.ControlArgument, ct.ControlDimension)
        with pytest.raises(wrong, match="force_map"):
            rco.mechanical([1.0, 1.0], K=np.eye(2), force_map=F)
        with pytest.raises(wrong, match=r"\bforce\b"):
            rco.mass_spring_damper([1.0, 1.0], [1.0, 1.0], [1.0, 1.0], force=F)
