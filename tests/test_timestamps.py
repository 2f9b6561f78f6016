"""Records off the grid: stamps as clocks give them, and slower records behind a filter."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from scipy.signal import cont2discrete

import rcorefine as rco
from rcorefine import DataError, Measurement

TRUE = {"m1": 1.0, "m2": 0.8, "c1": 0.9, "c2": 1.2, "c3": 0.4, "k1": 900.0, "k2": 600.0, "k3": 500.0}


def two_masses(seed: int, n: int = 20_000, dt: float = 2e-3, noise: float = 0.02) -> Measurement:
    """Stepwise force on two masses, simulated by scipy, exact under the hold."""
    rng = np.random.default_rng(seed)
    plant = rco.mass_spring_damper([1.0, 0.8], [0.9, 1.2, 0.4], [900.0, 600.0, 500.0]).system
    w = np.repeat(rng.standard_normal((plant.ninputs, n // 10)), 10, axis=1)
    A, B, C, D, _ = cont2discrete((plant.A, plant.B, plant.C, plant.D), dt, "zoh")
    x, y = np.zeros(4), np.empty((plant.noutputs, n))
    for k in range(n):
        y[:, k] = C @ x + D @ w[:, k]
        x = A @ x + B @ w[:, k]
    y += noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    return Measurement(w, y, dt=dt, input_labels=plant.input_labels, output_labels=plant.output_labels)


def off(data: Measurement) -> list[float]:
    """Errors of the estimates in their standard deviations."""
    start = rco.mass_spring_damper([1.0, 0.8], [1.1, 1.0, 0.5], [1000.0, 550.0, 550.0])
    rows = rco.refine(start, data, free="linear").parameters
    return [(row.value - TRUE[row.name]) / row.std for row in rows if row.name in TRUE]


# ---------------------------------------------------------------- decimation
def test_a_linear_plant_keeps_its_relation():
    data = two_masses(0, n=8000, noise=0.0)
    plant = rco.mass_spring_damper([1.0, 0.8], [0.9, 1.2, 0.4], [900.0, 600.0, 500.0])
    assert rco.compare(plant, data.decimate(5)).fit.min() > 99.9
    assert rco.compare(plant, Measurement(  # what leaving out samples does
        data.inputs[:, ::4], data.outputs[:, ::4], dt=4 * data.dt, hold="bandlimited"
    )).fit.min() < 99.0  # fmt: skip


def test_estimates_from_a_decimated_record():
    z = np.array([off(two_masses(seed).decimate(5)) for seed in range(3)])
    assert np.abs(z).mean() < 1.5  # 0.8 for normal ones


@pytest.mark.slow
def test_estimates_from_a_decimated_record_are_unbiased():
    """Normal errors: the mean of 20 within 3.5/sqrt(20), 95 % of 160 within 2."""
    z = np.array([off(two_masses(seed).decimate(5)) for seed in range(20)])
    assert np.abs(z.mean(axis=0)).max() < 3.5 / np.sqrt(20)
    assert (np.abs(z) < 2).mean() > 0.85


@pytest.mark.parametrize("hold", ["zoh", "foh", "bandlimited"])
def test_the_filter_sees_what_the_hold_says(hold):
    """A sine through each hold: amplitude and delay of its fundamental are known in closed form."""
    dt, omega, factor = 0.01, 20.0, 4
    t = np.arange(3000) * dt
    data = Measurement(np.sin(omega * t), np.sin(omega * t), dt=dt, hold=hold).decimate(factor)
    s = np.sinc(omega * dt / 2 / np.pi)
    gain, delay = {"zoh": (s, dt / 2), "foh": (s**2, 0.0), "bandlimited": (1.0, 0.0)}[hold]
    np.testing.assert_allclose(data.inputs[0], gain * np.sin(omega * (data.timepts - delay)), atol=3e-4)
    np.testing.assert_allclose(data.outputs[0], np.sin(omega * data.timepts), atol=3e-4)
    assert (data.hold, data.dt) == ("bandlimited", factor * dt)
    assert "zero-phase low-pass" in data.notes[-1]


def test_nothing_is_aliased():
    t = np.arange(4000) * 1e-3
    fast = np.sin(1.2 * np.pi / 5e-3 * t)  # above the new Nyquist frequency
    data = Measurement(np.ones(4000), 7.0 + fast, dt=1e-3).decimate(5)
    np.testing.assert_allclose(data.outputs, 7.0, atol=2e-4)
    np.testing.assert_allclose(data.inputs, 1.0, atol=1e-12)


@pytest.mark.parametrize(
    "factor, error", [(1, ct.ControlArgument), (2.5, ct.ControlArgument), (200, DataError)]
)
def test_factors_that_are_none(factor, error):
    with pytest.raises(error, match="factor|too few"):
        Measurement(np.zeros(500), np.arange(500.0), dt=1).decimate(factor)


# ---------------------------------------------------------------- stamps
def stamps(rng, n=2000, dt=0.01, jitter=0.15):
    return np.arange(n) * dt + jitter * dt * rng.standard_normal(n).clip(-2, 2)


def test_jitter():
    rng = np.random.default_rng(0)
    t = stamps(rng)
    data = Measurement.from_timestamps(t, np.cos(7 * t), np.sin(9 * t), hold="foh", output_labels="speed")
    np.testing.assert_allclose(data.dt, 0.01, rtol=1e-4)
    error = np.sqrt(np.mean((data.outputs[0] - np.sin(9 * data.timepts)) ** 2))
    stated = float(data.notes[0].split("is at most ")[1].split()[0])
    assert error < stated < 1e-3
    assert (data.hold, data.output_labels) == ("foh", ("speed",))
    assert "steps scatter by 20 %" in data.notes[0]


def test_order_and_doubles_do_not_matter():
    rng = np.random.default_rng(1)
    t = stamps(rng)
    w, y = np.sign(np.sin(3 * t)), np.sin(2 * t)
    plain = Measurement.from_timestamps(t, w, y)
    mixed = np.concatenate([rng.permutation(t.size), [5, 900]])  # two samples came twice
    data = Measurement.from_timestamps(t[mixed], w[mixed], y[mixed])
    np.testing.assert_allclose(data.outputs, plain.outputs, atol=1e-12)
    np.testing.assert_allclose(data.inputs, plain.inputs, atol=1e-9)
    assert any("were sorted" in note for note in data.notes)
    assert any("2 stamps were double" in note for note in data.notes)


def test_held_inputs_keep_their_impulse():
    """Switches between the points of the grid: the integral of the input is that of the command."""
    when = np.array([0.0, 0.333, 0.7071, 1.11, 1.5])
    level = np.array([0.0, 2.0, -1.0, 0.5, 0.0])
    t = np.arange(0, 2, 0.01)
    data = Measurement.from_timestamps(when, level, np.sin(t), output_timepts=t)
    assert data.dt == 0.01
    area = 2 * (0.7071 - 0.333) - (1.11 - 0.7071) + 0.5 * (1.5 - 1.11)
    np.testing.assert_allclose(data.inputs.sum() * data.dt, area, atol=1e-9)


def test_two_clocks_keep_what_both_cover():
    rng = np.random.default_rng(2)
    t_w, t_y = stamps(rng, 1500, 0.013), 1.0 + stamps(rng, 1500, 0.01)
    data = Measurement.from_timestamps(t_w, np.cos(t_w), np.sin(t_y), output_timepts=t_y, hold="foh", dt=0.01)
    assert data.timepts[0] >= 1.0 - 0.01
    assert data.timepts[-1] <= min(t_w.max(), t_y.max())
    np.testing.assert_allclose(data.inputs[0], np.cos(data.timepts), atol=1e-3)
    np.testing.assert_allclose(data.outputs[0], np.sin(data.timepts), atol=1e-6)


def test_a_slower_grid_is_not_aliased():
    rng = np.random.default_rng(3)
    t = stamps(rng, 6000, jitter=0.02)
    data = Measurement.from_timestamps(t, np.zeros(t.size), np.sin(t) + np.sin(75 * t), dt=0.05)
    np.testing.assert_allclose(data.outputs[0], np.sin(data.timepts), atol=2e-3)
    assert (data.dt, data.hold) == (0.05, "bandlimited")


def test_dates():
    t = np.datetime64("2024-03-12T10:00:00") + (np.arange(50) * 100).astype("timedelta64[ms]")
    assert Measurement.from_timestamps(t, np.zeros(50), np.arange(50.0)).dt == 0.1


T, W = np.arange(100) * 0.1, np.zeros(100)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"timepts": np.delete(T, range(40, 50))}, ct.ControlDimension, "inputs have 100 .* timepts 90"),
        ({"output_timepts": T[:7]}, ct.ControlDimension, "outputs have 100 .* output_timepts 7"),
        ({"timepts": np.where(T > 5, T + 3, T)}, DataError, r"1 gap\(s\) of more than 0\.3 s \(5 \.\.\. 8"),
        ({"timepts": np.where(T > 5, np.nan, T)}, DataError, "not finite at sample 51"),
        ({"timepts": np.ones(100)}, DataError, "all inputs are stamped 1 s"),
        ({"timepts": T.reshape(2, 50)}, ct.ControlDimension, "one time per sample"),
        ({"output_timepts": T + 50, "hold": "foh"}, DataError, "no stretch of time in common"),
        ({"inputs": np.where(T > 5, np.nan, W)}, DataError, "input 'i.0.' is NaN at sample 51"),
        ({"outputs": np.where(T > 5, np.inf, W)}, DataError, "output .* is Inf at sample 51"),
        ({"dt": -1.0}, DataError, "dt"),
        ({"longest_gap": 0.0}, DataError, "longest_gap"),
        ({"hold": "spline"}, ct.ControlArgument, "hold"),
        ({"name": 7}, ct.ControlArgument, "name"),
    ],
)
def test_bad_arguments(change, error, message):
    with pytest.raises(error, match=message):
        Measurement.from_timestamps(**({"timepts": T, "inputs": W, "outputs": T} | change))


def test_gaps_can_be_filled_in_when_asked():
    t = np.delete(T, range(50, 54))
    with pytest.raises(DataError, match="longest_gap="):
        Measurement.from_timestamps(t, W[: t.size], np.sin(t))
    assert Measurement.from_timestamps(t, W[: t.size], np.sin(t), longest_gap=1.0).n_samples == 100


# ---------------------------------------------------------------- clocks that are set
@pytest.mark.parametrize("back", [0.5, 5.0, 5.04, 12.3, 20.0])
def test_a_clock_that_was_set_back_is_no_disorder(back):
    """Two stretches with the same times were laid over each other, their means taken."""
    t, rng = 0.1 * np.arange(400), np.random.default_rng(6)
    y = rng.standard_normal(400)
    set_back = t - back * (t >= 20.0)
    with pytest.raises(DataError, match=rf"outputs: the clock was set back by {back:g} s behind sample 199"):
        Measurement.from_timestamps(set_back, np.zeros(400), y)
    with pytest.raises(DataError, match="a record of each stretch"):
        Measurement.from_timestamps(set_back + 0.004 * rng.uniform(-1, 1, 400), y, y)
    with pytest.raises(DataError, match=r"1 gap\(s\)"):
        Measurement.from_timestamps(t + back * (t >= 20.0), np.zeros(400), y)


def test_a_clock_that_is_set_back_again_and_again():
    t = np.tile(0.1 * np.arange(100), 5)
    with pytest.raises(DataError, match=r"set back by 10 s behind sample 99"):
        Measurement.from_timestamps(t, np.zeros(500), np.sin(0.3 * np.arange(500)))


@pytest.mark.parametrize("seed", range(20))
def test_what_comes_late_or_twice_is_no_clock(seed):
    """A packet behind the next one, a packet twice, a single sample from before, times that trade places."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(400) + 0.01 * rng.uniform(-1, 1, 400)
    w, y = rng.standard_normal(400), rng.standard_normal(400)
    plain = Measurement.from_timestamps(t, w, y)
    first, size = int(rng.integers(20, 300)), int(rng.integers(3, 30))
    packet, every = np.arange(first, first + size), np.arange(400)
    late = np.r_[every[:first], packet + size, packet, every[first + 2 * size :]]
    twice = np.r_[every[: first + size], packet, every[first + size :]]
    one = np.r_[np.delete(every, first)[: first + size], first, every[first + size + 1 :]]
    near = every.copy()
    near[[first, first + 1]] = near[[first + 1, first]]
    for order in (late, twice, one, near):
        found = Measurement.from_timestamps(t[order], w[order], y[order])
        np.testing.assert_allclose(found.outputs, plain.outputs, atol=1e-12)
        np.testing.assert_allclose(found.inputs, plain.inputs, atol=1e-9)


def test_the_grid_lies_on_the_switches_of_a_held_input():
    """A command every 0.1 s by one clock, samples by another that began 3 ms later: nothing is shared out."""
    rng = np.random.default_rng(0)
    t = 0.003 + 0.02 * np.arange(400) + 0.002 * rng.random(400)
    command = rng.standard_normal(81)
    data = Measurement.from_timestamps(
        0.1 * np.arange(81), command, np.sin(t), output_timepts=t, dt=0.02, longest_gap=0.2
    )
    assert np.abs(data.inputs.T - command).min(axis=1).max() < 1e-9
    np.testing.assert_allclose(data.timepts[0], 0.02, atol=1e-12)


def test_a_file_with_a_jittered_clock_needs_one_line(tmp_path):
    rng = np.random.default_rng(5)
    t = np.arange(300) * 0.02 + rng.uniform(-0.003, 0.003, 300)
    u, y = np.sign(np.sin(3.0 * t)), np.sin(5.0 * t)
    path = tmp_path / "log.csv"
    path.write_text("t,u,y\n" + "".join(f"{a!r},{b!r},{c!r}\n" for a, b, c in np.c_[t, u, y].tolist()))
    with pytest.raises(
        rco.DataError, match=r"time=\.\.\., dt=0\.02.*from_timestamps\(timepts, inputs, outputs"
    ):
        rco.Measurement.from_csv(path, "u", "y", time="t")
    data = rco.Measurement.from_csv(path, "u", "y", time="t", dt=0.02)
    assert data.dt == 0.02
    assert data.name == "log"
    assert len(data.notes) > 1  # how the file was read, and what was done to the stamps
    np.testing.assert_allclose(data.outputs[0], np.sin(5.0 * data.timepts), atol=1e-4)
    by_hand = rco.Measurement.from_timestamps(t, u, y, dt=0.02)
    np.testing.assert_array_equal(data.inputs, by_hand.inputs)
    frame = {"t": t, "u": u, "y": y}
    np.testing.assert_array_equal(
        rco.Measurement.from_frame(frame, "u", "y", time="t", dt=0.02).outputs, data.outputs
    )
    regular = frame | {"t": np.arange(300) * 0.02}
    with pytest.raises(rco.DataError, match="contradicts"):
        rco.Measurement.from_frame(regular, "u", "y", time="t", dt=0.01)
