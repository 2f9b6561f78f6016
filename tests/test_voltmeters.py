"""A sensor across an element reads all that the element drops, what is missing included."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from cases import named, slow
from inner import Engine, Structure
from scipy.integrate import solve_ivp

import rcorefine as rco

R, L, C, DT = 40.0, 0.02, 5e-5, 2e-4
ELEMENTS = {"resistor": "damping", "inductor": "mass", "capacitor": "stiffness"}


def circuit(sensor):
    return rco.series_rlc(R, L, C, sensors=sensor, inputs="U", outputs="meter")


def drive(rng, n):
    return 5 * np.repeat(rng.choice([-1.0, 1.0], n // 20), 20)


def recorded(w, y, rng):
    noisy = y + 0.02 * y.std() * rng.normal(size=y.size)
    return rco.Measurement(w, noisy, dt=DT, input_labels="U", output_labels="meter")


def test_a_voltmeter_reads_a_nonlinear_drop(rng):
    w, c = drive(rng, 200), 300.0
    model = rco.series_rlc(R, L, C, sensors=["resistor_voltage", "current", "inductor_voltage"])
    structure = Structure(model, [rco.Effect("quadratic_damping", "resistor")])
    data = rco.Measurement(w, np.zeros((3, w.size)), dt=DT, hold="zoh")
    run = Engine(structure, data, substeps=16).run(np.array([c]), sensitivity=True)
    x, states = np.zeros(2), []
    for u in w:
        states.append(x)
        rhs = lambda t, x, u=u: [x[1], (u - R * x[1] - c * x[1] * abs(x[1]) - x[0] / C) / L]  # noqa: E731
        x = solve_ivp(rhs, (0, DT), x, rtol=1e-10, atol=1e-14).y[:, -1]
    q, i = np.array(states).T
    drop = R * i + c * i * np.abs(i)
    expected = np.array([drop, i, w - drop - q / C])
    assert np.abs(run.outputs - expected).max() < 1e-4 * np.abs(expected).max()
    more = Engine(structure, data, substeps=16).run(np.array([c + 0.01]), sensitivity=False).outputs
    slope = (more - run.outputs) / 0.01
    assert np.abs(run.sensitivity[:, :, 0] - slope).max() < 1e-3 * np.abs(slope).max()


@pytest.mark.parametrize("element", ["resistor", *slow("inductor", "capacitor")])
def test_the_metered_element_itself_is_off(element, rng):
    values = {"R": R, "L": L, "C": C}
    name = {"resistor": "R", "inductor": "L", "capacitor": "C"}[element]
    values[name] *= 1.2
    true = rco.series_rlc(**values, sensors=f"{element}_voltage").system.sample(DT)
    w = drive(rng, 1500)
    y = ct.forced_response(true, inputs=w).outputs
    data = recorded(w, y, rng)
    found = rco.diagnose(circuit(f"{element}_voltage"), data)
    truth = {"resistor": 0.2 * R, "inductor": 0.2 * L, "capacitor": 1 / (1.2 * C) - 1 / C}[element]
    named(found, rco.Effect(ELEMENTS[element], element), truth)


def test_resistance_of_the_coil_is_not_the_metered_resistor(rng):
    w = drive(rng, 1500)
    true = ct.ss([[0, 1], [-1 / (L * C), -1.2 * R / L]], [[0], [1 / L]], [[0, R]], 0).sample(DT)
    y = ct.forced_response(true, inputs=w).outputs
    data = recorded(w, y, rng)
    found = rco.diagnose(circuit("resistor_voltage"), data)
    named(found, rco.Effect("damping", "inductor"), 0.2 * R)


def test_sizes_of_what_sensors_read_are_checked():
    model = circuit("current")
    port = model.port("resistor")
    two = rco.Port(port.name, port.kind, port.act, port.position, port.velocity, output=np.ones(2))
    with pytest.raises(ct.ControlDimension, match="output of port 'resistor' has 2 entries for 1 outputs"):
        replace(model, ports=(two,), parameters=())
