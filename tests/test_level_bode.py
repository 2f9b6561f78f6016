"""Frequency response by amplitude: closed forms, solve_ivp and the engine as oracles; the level picture."""

from __future__ import annotations

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest
from inner import Engine, Frame, Structure
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import rcorefine as rco
from rcorefine.data.records import stretches_by_level
from rcorefine.systems.response import hold_factor
from rcorefine.views.bode import level_bode

M, C, K = 1.0, 0.4, 100.0


class Held:
    """A model with effects at given coefficients: what a Refinement is to the engine."""

    def __init__(self, model, effects, theta, constants=None):
        self.structure = Structure(model, effects, constants=constants)
        self.theta = np.array(theta, dtype=float)

    def simulation_structure(self):
        return self.structure, self.theta, 4


def spring(**options):
    return rco.mass_spring_damper([M], [C], [K], **options)


def with_effect(kind, values, place="link1", width=None, model=None, **options):
    effect = rco.Effect(kind, place, **options)
    return Held(model or spring(), [effect], values, None if width is None else {0: width})


def stiffness_at(omega):
    """Force per displacement of the linear model."""
    return K - M * omega**2 + 1j * C * omega


# ------------------------------------------------------------------ linear models
@pytest.mark.parametrize("seed", range(6))
def test_linear_model_answers_alike_at_every_amplitude(seed):
    """A chain with every linear effect: C (jw - A)^-1 B + D, whatever the amplitude."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    model = rco.mass_spring_damper(
        rng.uniform(0.5, 2, n), rng.uniform(0.1, 1, n), rng.uniform(50, 200, n), sensors="acceleration"
    )
    effects = [
        rco.Effect("stiffness", "link1"),
        rco.Effect("hidden_mode", "mass1"),
        rco.Effect("input_lag", "force"),
        rco.Effect("output_gain", "a1"),
        rco.Effect("input_offset", "force"),
    ]
    held = Held(model, effects, [10.0, 0.1, 0.05, 12.0, 0.02, -0.2, 0.3])
    omega = np.geomspace(0.5, 60, 15)
    exact = ct.frequency_response(held.structure.system(held.theta), omega).frdata[:, 0]
    found = rco.frequency_response_at(held, omega, [1e-3, 1.0, 1e3])
    for level in range(3):
        assert np.allclose(found.response[level], exact, rtol=1e-9, atol=1e-12 * np.abs(exact).max())
    assert found.distortion.max() < 1e-9
    assert found.converged.all()
    assert found.stable.all()


# ------------------------------------------------------------------ closed forms
def duffing(omega, amplitude, cubic):
    """Single-term harmonic balance: |K(w) + 3/4 k3 X^2| X = F; all real roots."""
    s = stiffness_at(omega)
    g = 0.75 * cubic
    # (a + g u)^2 u + b^2 u = F^2 in u = X^2
    roots = np.roots([g * g, 2 * g * s.real, abs(s) ** 2, -(amplitude**2)])
    squares = np.sort(roots[np.abs(roots.imag) < 1e-7 * np.abs(roots)].real)
    return np.array([1 / (s + g * u) for u in squares if u > 0])


@pytest.mark.parametrize("cubic", [200.0, -150.0, 2000.0])
@pytest.mark.parametrize("sweep", ["up", "down"])
def test_duffing_single_term(cubic, sweep):
    """One harmonic balanced is the describing function 3/4 k3 X^2, on either branch."""
    held = with_effect("cubic_stiffness", [cubic])
    omega = np.linspace(4, 16, 49)
    amplitude = 1.0 if cubic < 0 else 3.0
    found = rco.frequency_response_at(held, omega, amplitude, harmonics=1, sweep=sweep)
    assert found.converged.all()
    for w, g, stable in zip(omega, found.response[0, 0], found.stable[0], strict=True):
        branches = duffing(w, amplitude, cubic)
        assert np.abs(branches - g).min() < 1e-6 * abs(g)
        if stable and len(branches) == 3:
            # the middle one is the unstable one
            assert np.abs(branches - g).argmin() != 1


def test_hardening_spring_jumps_by_the_direction_of_the_sweep():
    held = with_effect("cubic_stiffness", [2000.0])
    omega = np.linspace(9, 16, 57)
    up = np.abs(rco.frequency_response_at(held, omega, 2.0).response[0, 0])
    down = np.abs(rco.frequency_response_at(held, omega, 2.0, sweep="down").response[0, 0])
    several = np.array([len(duffing(w, 2.0, 2000.0)) == 3 for w in omega])
    inside = several[1:-1] & several[:-2] & several[2:]
    assert inside.sum() > 5
    assert (up[1:-1][inside] > 1.5 * down[1:-1][inside]).all()
    alone = ~several
    alone[1:-1] &= ~(several[:-2] | several[2:])
    assert np.allclose(up[alone], down[alone], rtol=1e-6)


def test_small_nonlinearity_needs_one_term_only():
    """The full balance departs from the single term by the third harmonic: second order in k3 X^2."""
    departure = []
    for cubic in (1.0, 2.0, 4.0):
        full = rco.frequency_response_at(with_effect("cubic_stiffness", [cubic]), [7.0], 10.0).response[
            0, 0, 0
        ]
        departure.append(abs(full - duffing(7.0, 10.0, cubic)[0]) / abs(full))
    assert departure[0] < 1e-5
    assert departure[1] / departure[0] == pytest.approx(4.0, rel=0.15)
    assert departure[2] / departure[1] == pytest.approx(4.0, rel=0.15)


@pytest.mark.parametrize("omega", [5.0, 9.0, 10.0, 14.0])
@pytest.mark.parametrize("force", [0.2, 1.0])
def test_coulomb_single_term(omega, force):
    """Describing function of dry friction, 4 F / (pi V), where the mass does not stick."""
    amplitude = 4.0
    s, drag = stiffness_at(omega), 4 * force / np.pi
    size = brentq(lambda x: abs(s * x + 1j * drag) - amplitude, 0.0, 10.0)
    exact = size * np.exp(-1j * np.angle(s * size + 1j * drag)) / amplitude
    held = with_effect("coulomb_friction", [force], width=1e-6)
    found = rco.frequency_response_at(held, [omega], amplitude, harmonics=1)
    assert found.response[0, 0, 0] == pytest.approx(exact, rel=2e-3)


@pytest.mark.parametrize("omega", [5.0, 10.0, 14.0])
def test_quadratic_damping_single_term(omega):
    """t v |v| acts as a damper of 8 / (3 pi) t w X."""
    t, amplitude = 2.0, 4.0
    s = stiffness_at(omega)
    size = brentq(lambda x: abs(s + 8j / (3 * np.pi) * t * omega**2 * x) * x - amplitude, 0.0, 10.0)
    exact = 1 / (s + 8j / (3 * np.pi) * t * omega**2 * size)
    found = rco.frequency_response_at(with_effect("quadratic_damping", [t]), [omega], amplitude, harmonics=1)
    assert found.response[0, 0, 0] == pytest.approx(exact, rel=1e-3)


def test_stuck_friction_holds_the_mass():
    """Below breakaway nothing moves but the small slope of sgn(v)."""
    held = with_effect("coulomb_friction", [2.0], width=1e-4)
    found = rco.frequency_response_at(held, [3.0, 6.0], 1.0)
    assert found.converged.all()
    assert (np.abs(found.response) < 1e-3 / K * 10).all()
    assert found.forces[0, 0] == pytest.approx([1.0, 1.0], rel=1e-3)


def lag():
    return ct.ss([[-2.0]], [[2.0]], [[1.0]], [[0.0]], inputs="u", outputs="y", states=["level"])


def test_static_laws_at_the_ends_of_the_loop():
    """Clipped, dead and rectified sines have known fundamentals; delays turn the phase."""
    amplitude, omega = 2.0, 3.0
    linear = 1 / (1 + 1j * omega / 2)
    a = 0.6
    clipped = 2 / np.pi * (np.arcsin(a) + a * np.sqrt(1 - a * a))
    size = amplitude * abs(linear)
    cases = {
        ("input_saturation", "u", (a * amplitude,)): clipped * linear,
        ("input_deadzone", "u", (a * amplitude,)): (1 - clipped) * linear,
        ("input_delay", "u", (0.1,)): np.exp(-0.1j * omega) * linear,
        ("output_delay", "y", (0.1,)): np.exp(-0.1j * omega) * linear,
        ("output_average", "y", (0.4,)): (1 - np.exp(-0.4j * omega)) / (0.4j * omega) * linear,
        ("output_saturation", "y", (a * size,)): clipped * linear,
        ("output_rectification", "y", (0.3,)): 0.7 * linear,
    }
    for (kind, place, values), exact in cases.items():
        held = with_effect(kind, values, place=place, model=lag())
        found = rco.frequency_response_at(held, [omega], amplitude, harmonics=127)
        assert found.response[0, 0, 0] == pytest.approx(exact, rel=1e-4), kind
        if kind == "output_rectification":
            assert found.mean[0, 0, 0] == pytest.approx(0.3 * 2 / np.pi * size, rel=1e-3)


# ------------------------------------------------------------------ independent oracles
LAWS = {
    "cubic_stiffness": ((800.0,), lambda d, v: 800 * d**3, None),
    "quadratic_stiffness": ((60.0,), lambda d, v: 60 * d * d, None),
    "bilinear_stiffness": ((60.0,), lambda d, v: 60 * max(d, 0.0), None),
    "clearance": ((200.0, 0.05), lambda d, v: 200 * np.sign(d) * max(abs(d) - 0.05, 0.0), None),
    "asymmetric_damping": ((0.5, 2.0), lambda d, v: (0.5 if v > 0 else 2.0) * v, None),
    "cubic_damping": ((1.0,), lambda d, v: v**3, None),
    "coulomb_friction": ((1.0,), lambda d, v: np.tanh(v / 0.01), 0.01),
    "asymmetric_friction": ((1.0, 0.4), lambda d, v: (1.0 if v > 0 else 0.4) * np.tanh(v / 0.01), 0.01),
    "stribeck_friction": (
        (0.5, 0.9, 0.1),
        lambda d, v: (0.5 + 0.4 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.01),
        0.01,
    ),
}


def settled(law, omega, amplitude, damping=C, periods=None, start=(0.0, 0.0)):
    """Fundamental of the displacement over the force after the transient, by solve_ivp."""
    turn = 2 * np.pi / omega
    periods = periods or int(np.ceil(40 / (0.5 * damping) / turn))
    end = periods * turn

    def rates(t, x):
        return [x[1], amplitude * np.cos(omega * t) - damping * x[1] - K * x[0] - law(x[0], x[1])]

    grid = end + turn * np.arange(512) / 512
    x = solve_ivp(
        rates, (0, end + turn), start, rtol=1e-8, atol=1e-10, t_eval=grid, max_step=turn / 60, method="LSODA"
    ).y[0]
    return 2 * np.mean(x * np.exp(-1j * omega * grid)) / amplitude


@pytest.mark.parametrize("kind", list(LAWS))
def test_against_solve_ivp(kind):
    """Rising stiffness, stops, friction: below, at and above the resonance, two amplitudes."""
    values, law, width = LAWS[kind]
    model = rco.mass_spring_damper([M], [1.5], [K])
    held = with_effect(kind, values, width=width, model=model)
    for omega, amplitude in ((6.0, 4.0), (9.5, 2.0), (9.5, 6.0), (14.0, 4.0)):
        exact = settled(law, omega, amplitude, damping=1.5)
        found = rco.frequency_response_at(held, [omega], amplitude)
        assert found.converged.all()
        rel = 1e-2 if width else 1e-3
        assert abs(found.response[0, 0, 0] - exact) < rel * abs(exact), (omega, amplitude)


def test_unstable_answer_is_not_taken_for_what_is_seen():
    """Stops drive an even harmonic: the symmetric answer loses its stability, the motion takes another."""
    held = with_effect("clearance", [300.0, 0.05])
    exact = settled(lambda d, v: 300 * np.sign(d) * max(abs(d) - 0.05, 0.0), 6.0, 4.0)
    found = rco.frequency_response_at(held, [6.0], 4.0)
    assert found.stable.all()
    assert abs(found.response[0, 0, 0] - exact) < 2e-3 * abs(exact)
    assert found.distortion[0, 0, 0] > 0.3


def engine_answer(held, omega, amplitude, periods=300, per=128, channel=0):
    """Fundamental of the outputs at the end of a long simulation with the engine."""
    structure, theta, _ = held.simulation_structure()
    n = (periods + 1) * per
    w = np.zeros((structure.n_inputs, n))
    w[channel] = amplitude * np.cos(2 * np.pi * np.arange(n) / per)
    blank = rco.Measurement(w, np.zeros((structure.n_outputs, n)), dt=2 * np.pi / omega / per, hold="foh")
    y = Engine(structure, blank, substeps=4).run(theta, sensitivity=False).outputs[:, -per:]
    turn = np.exp(-2j * np.pi * np.arange(n)[-per:] / per)
    # straight lines between the samples of a sine have a fundamental smaller by sinc^2
    return 2 * (y * turn).mean(axis=1) / amplitude / np.sinc(1 / per) ** 2


@pytest.mark.parametrize("seed", range(8))
def test_against_the_engine_on_random_structures(seed):
    """Chains of 2 to 4 masses with two effects of different kinds, memory included."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    model = rco.mass_spring_damper(
        rng.uniform(0.6, 1.6, n), rng.uniform(2, 4, n), rng.uniform(120, 350, n), sensors="velocity"
    )
    choices = [
        ("cubic_stiffness", (2000.0,), None),
        ("hysteresis", (2.0, 0.01), None),
        ("asymmetric_damping", (3.0, 1.0), None),
        ("quadratic_damping", (4.0,), None),
        ("coulomb_friction", (1.0,), 5e-3),
        ("bilinear_stiffness", (80.0,), None),
    ]
    first, second = rng.choice(len(choices), 2, replace=False)
    effects, theta, constants = [], [], {}
    for i, which in enumerate((first, second)):
        kind, values, width = choices[which]
        effects.append(rco.Effect(kind, f"link{i + 1}"))
        theta += values
        if width is not None:
            constants[i] = width
    held = Held(model, effects, theta, constants)
    for omega in rng.uniform(4, 30, 2):
        found = rco.frequency_response_at(held, [omega], 8.0)
        exact = engine_answer(held, omega, 8.0)
        assert found.converged.all()
        assert np.abs(found.response[0, :, 0] - exact).max() < 1e-2 * np.abs(exact).max()


def knee(d, v):
    return 30.0 * np.tanh(20 * d)


def test_own_law():
    """A law of the user's own, against solve_ivp."""
    held = with_effect("custom", [1.0], law=knee)
    exact = settled(knee, 13.0, 3.0)
    assert rco.frequency_response_at(held, [13.0], 3.0).response[0, 0, 0] == pytest.approx(exact, rel=2e-3)


def test_integrator_with_friction():
    """A motor's angle integrates: the speed's answer is unaffected, the angle's is speed over jw."""
    model = rco.dc_motor(gain=2.0, time_constant=0.5, sensors=["speed", "angle"])
    effects = [rco.Effect("coulomb_friction", "shaft"), rco.Effect("input_offset", "voltage")]
    held = Held(model, effects, [0.3, 0.01], {0: 1e-3})
    found = rco.frequency_response_at(held, [2.0, 8.0], 3.0)
    assert found.converged.all()
    assert found.response[0, 1] == pytest.approx(found.response[0, 0] / (1j * found.omega), rel=1e-6)


# ------------------------------------------------------------------ peaks between the frequencies
def highest(amplitude, cubic):
    """Peak of `duffing` and its frequency: the displacement beyond which no frequency answers."""

    def beyond(x):
        return C**4 - 4 * C**2 * M * (K + 0.75 * cubic * x**2) + (2 * M * amplitude / x) ** 2

    x = brentq(beyond, 1e-9, 10 * amplitude / (C * np.sqrt(K / M)), xtol=1e-14)
    return x / amplitude, np.sqrt((K + 0.75 * cubic * x**2) / M - C**2 / (2 * M**2))


@pytest.mark.parametrize(("amplitude", "cubic"), [(1.0, 0.0), (0.5, 60.0), (2.0, 60.0), (4.0, 60.0)])
def test_a_coarse_grid_neither_passes_over_the_peak_nor_leaves_its_branch(amplitude, cubic):
    """A linear oscillator and the single-term balance of Duffing's, both in closed form."""
    gain, at = highest(amplitude, cubic)
    found = rco.frequency_response_at(
        with_effect("cubic_stiffness", [cubic]), np.linspace(5, 20, 31), amplitude, harmonics=1
    )
    assert found.peak_gain[0, 0] == pytest.approx(gain, rel=5e-3)
    assert found.peak_omega[0, 0] == pytest.approx(at, rel=5e-3)
    for w, g in zip(found.omega, found.response[0, 0], strict=True):
        upper = np.abs(duffing(w, amplitude, cubic)).max()  # swept upward: the upper branch to its end
        assert w > at or abs(g) == pytest.approx(upper, rel=1e-6)


def test_picture_and_table_show_one_peak():
    """Default grid of the picture, coarse grid of the table; harmonics add a percent at most here."""
    held, levels = with_effect("cubic_stiffness", [60.0]), [0.5, 4.0]
    curves = level_bode(held, levels, None, None, Frame()).lines[0, 0]
    drawn = [np.nanmax(np.abs(line.get_ydata())) for line in curves if "sine" in line.get_label()]
    rows = str(rco.frequency_response_at(held, np.linspace(5, 20, 31), levels)).splitlines()[3:5]
    printed = [float(row.split()[3]) for row in rows]
    exact = [highest(level, 60.0)[0] for level in levels]
    assert drawn == pytest.approx(exact, rel=0.01)
    assert printed == pytest.approx(exact, rel=0.01)


# ------------------------------------------------------------------ arguments, table, pickle
def test_arguments_are_checked():
    model = spring()
    for omega, amplitude in (([0.0], 1.0), ([1.0], 0.0), ([np.nan], 1.0), ([1.0], [-1.0]), ([], 1.0)):
        with pytest.raises(rco.ModelError, match="positive"):
            rco.frequency_response_at(model, omega, amplitude)
    with pytest.raises(ct.ControlArgument, match="no input 'nix'; there are force"):
        rco.frequency_response_at(model, [1.0], 1.0, source="nix")
    with pytest.raises(ct.ControlArgument, match="harmonics"):
        rco.frequency_response_at(model, [1.0], 1.0, harmonics=0)
    with pytest.raises(ct.ControlArgument, match="sweep"):
        rco.frequency_response_at(model, [1.0], 1.0, sweep="sideways")


def test_table_names_the_peak():
    omega = np.linspace(8, 12, 81)
    found = rco.frequency_response_at(spring(), omega, [1.0, 2.0])
    text = str(found)
    assert all(len(line) <= 80 for line in text.splitlines())
    peak = 1 / np.abs(stiffness_at(omega))
    assert f"{peak.max():.4g}" in text
    assert f"{omega[peak.argmax()]:.5g}" in text
    assert "1 N" in text


def test_order_of_the_frequencies_does_not_matter():
    held = with_effect("cubic_stiffness", [500.0])
    omega = np.array([12.0, 5.0, 9.0])
    mixed = rco.frequency_response_at(held, omega, 2.0).response[0, 0]
    sorted_ = rco.frequency_response_at(held, np.sort(omega), 2.0).response[0, 0]
    assert np.array_equal(mixed[np.argsort(omega)], sorted_)


# ------------------------------------------------------------------ record and picture
def test_stretches_by_level_are_those_planted():
    rng = np.random.default_rng(0)
    w = rng.standard_normal(9000)
    w[3000:6000] *= 4
    w[6000:] *= 20
    data = rco.Measurement(w, w, dt=0.01)
    found = stretches_by_level(data)
    assert [level for level, _ in found] == pytest.approx([1.0, 4.0, 20.0], rel=0.05)
    assert [part.n_samples for _, part in found] == [3000, 3000, 3000]
    assert len(stretches_by_level(rco.Measurement(w[:3000], w[:3000], dt=0.01))) == 1


def test_a_level_that_climbs_is_looked_at_in_thirds():
    """An "arrow": noise whose amplitude grows evenly; rms of the thirds by integration of the square."""
    n = 9000
    w = np.random.default_rng(1).standard_normal(n) * np.arange(n) / n
    found = stretches_by_level(rco.Measurement(w, w, dt=0.01))
    exact = [np.sqrt(((k + 1) ** 3 - k**3) / 27) for k in range(3)]
    # the very start, where the level doubles from block to block, belongs to none of them
    assert [level for level, _ in found] == pytest.approx(exact, rel=0.12)


def test_steady_levels_are_one_stretch_in_most_records():
    """White and coloured inputs of one level: not split, over 40 seeds."""
    split = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        w = np.convolve(rng.standard_normal(6000), np.ones(1 + seed % 10), "valid")
        split += len(stretches_by_level(rco.Measurement(w, w, dt=0.01))) > 1
    assert split <= 2


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_hold_factor_sums_to_the_sampled_response(hold):
    """A sampled response is the sum over all aliases of G times the hold's factor."""
    dt, tau = 0.1, 0.5
    omega = np.linspace(0.5, 28, 12)
    order = np.arange(-4000, 4001)[:, None]
    shifted = omega + 2 * np.pi / dt * order
    terms = 1 / (1 + 1j * tau * shifted) ** 2 * hold_factor(shifted, dt, hold)
    system = ct.tf(1, [tau, 1]) ** 2
    sampled = ct.ss(system).sample(dt, method=hold)
    assert terms.sum(axis=0) == pytest.approx(sampled(np.exp(1j * omega * dt)), rel=1e-6)


@pytest.fixture(scope="module")
def refined():
    """A record at two levels, and the model refined with its cubic spring."""
    rng = np.random.default_rng(2)
    model = rco.mass_spring_damper([M], [2.0], [K], sensors="displacement")
    effect = rco.Effect("cubic_stiffness", "link1")
    w = rng.standard_normal(4000)
    w[:2000] *= 2
    w[2000:] *= 20
    blank = rco.Measurement(w, np.zeros(4000), dt=0.02)
    y = (
        Engine(Structure(model, [effect]), blank, substeps=8)
        .run(np.array([400.0]), sensitivity=False)
        .outputs
    )
    y = y + 0.01 * y.std() * rng.standard_normal(y.shape)
    data = rco.Measurement(w, y, dt=0.02, name="bench")
    return rco.refine(model, data, [effect]), data


def test_level_bode_draws_levels_record_and_model(refined):
    better, data = refined
    omega = np.linspace(4, 25, 12)
    cplt = better.bode_plot(data, omega, levels=[1.0, 10.0], title="By level")
    assert cplt.axes.shape == (2, 1)
    assert cplt.figure.get_suptitle() == "By level"
    labels = [text.get_text() for text in cplt.legend.get_texts()]
    assert "1 N sine" in labels
    assert "10 N sine" in labels
    assert "initial model" in labels
    assert "refined model on the same input" in labels
    assert sum("bench" in label and "rms" in label for label in labels) == 2
    curves = {line.get_label(): line for line in cplt.lines[0, 0]}
    exact = rco.frequency_response_at(better, omega, 10.0).response[0, 0]
    drawn = np.asarray(curves["10 N sine"].get_ydata())
    assert drawn == pytest.approx(np.abs(exact) * np.sinc(omega * data.dt / 2 / np.pi), rel=1e-9)


def test_refined_model_meets_the_record_at_each_level(refined):
    """On the record's own input model and measured response differ by the noise, at both levels."""
    better, data = refined
    for _, part in stretches_by_level(data):
        measured = part.frequency_response()
        own = rco.Measurement(
            part.inputs, rco.simulate(better, part).outputs, dt=part.dt
        ).frequency_response()
        near = (measured.omega > 5) & (measured.omega < 20)
        off = np.abs(own.response - measured.response)[0, 0, near] / np.abs(measured.response)[0, 0, near]
        assert np.median(off) < 0.05


def test_level_bode_keywords(refined):
    better, _ = refined
    omega = [5.0, 10.0, 20.0]
    figure, axes = plt.subplots(2, 1)
    cplt = better.bode_plot(omega=omega, levels=[1.0], ax=axes, label=["soft"], legend_loc="lower left")
    assert cplt.figure is figure
    assert [t.get_text() for t in cplt.legend.get_texts()] == ["initial model", "soft"]
    assert better.bode_plot(omega=omega, levels=[1.0], show_legend=False).legend is None
    with pytest.raises(ct.ControlDimension, match="label"):
        better.bode_plot(omega=omega, levels=[1.0, 2.0], label="one")
    with pytest.raises(rco.DataError, match="levels is empty"):
        better.bode_plot(omega=omega, levels=[])
    with pytest.raises(ct.ControlArgument, match="measured must be"):
        level_bode(better, [1.0], [1, 2], omega, Frame())


@pytest.mark.parametrize("kind", ["coulomb_friction", "clearance", "stribeck_friction", "hysteresis"])
def test_kernels_are_the_same_compiled_or_not(kind):
    """One source; and a whole turn of Dahl's law leaves the inner state where it began."""
    from inner import KINDS

    from rcorefine.engine.kernels import law_over_period, memory_over_period

    turn = 2 * np.pi * np.arange(64) / 64
    d, row = 0.1 * np.cos(turn) + 0.02 * np.sin(3 * turn), np.array([[1.5, 0.03, 0.2, 0.0]])
    v, w, code = np.gradient(d), np.zeros((64, 1)), KINDS[kind].code
    if kind == "hysteresis":
        plain = getattr(memory_over_period, "py_func", memory_over_period)
        none = np.zeros(64)
        for one, two in zip(
            memory_over_period(code, d, v, w, row, 0.3, none),
            plain(code, d, v, w, row, 0.3, none),
            strict=True,
        ):
            assert np.allclose(one, two, rtol=1e-12, atol=1e-14)
        f, by, end, _, left = plain(code, d, v, w, row, 0.0, none)
        start = end / (1 - left)
        assert plain(code, d, v, w, row, start, none)[2] == pytest.approx(start, rel=1e-10)
        step = np.zeros(64)
        step[20] = 1e-7
        moved = plain(code, d + step, v, w, row, 0.0, none)[0]
        assert (moved - f) / 1e-7 == pytest.approx(by[:, 20], rel=1e-4, abs=1e-4)
    else:
        plain = getattr(law_over_period, "py_func", law_over_period)
        assert np.allclose(
            law_over_period(code, d, v, w, row, 0.01),
            plain(code, d, v, w, row, 0.01),
            rtol=1e-12,
            atol=1e-14,
        )
