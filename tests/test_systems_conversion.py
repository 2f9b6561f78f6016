"""d2c: round trips, an independent oracle, and what it refuses or doubts."""

import sys

import control as ct
import numpy as np
import pytest
from scipy import linalg

import rcorefine as rco


@pytest.fixture
def harold(monkeypatch):
    # harold 1.0.3 imports a module that numpy 2.4 has renamed.
    if "numpy.linalg.linalg" not in sys.modules:
        monkeypatch.setitem(sys.modules, "numpy.linalg.linalg", np.linalg._linalg)
    return pytest.importorskip("harold", exc_type=ImportError)


def random_system(rng, n, n_w=2, n_y=2):
    """Stable or slightly unstable, unit time scale, units of the states far apart."""
    a = rng.standard_normal((n, n)) - 0.5 * np.eye(n)
    a /= max(np.abs(np.linalg.eigvals(a)).max(), 1e-3)
    units = 10.0 ** rng.integers(-3, 4, n)
    return ct.ss(
        units[:, None] * a / units,
        units[:, None] * rng.standard_normal((n, n_w)),
        rng.standard_normal((n_y, n)) / units,
        rng.standard_normal((n_y, n_w)),
        name="plant",
    ), units


@pytest.mark.parametrize("method", ["zoh", "tustin"])
def test_round_trip_of_random_mimo_systems(rng, method):
    for _ in range(40):
        n = int(rng.integers(1, 8))
        plant, units = random_system(rng, n)
        back = rco.d2c(plant.sample(1.0, method, name="plant"), method)
        error = (back.A - plant.A) * units / units[:, None]
        assert np.abs(error).max() < 1e-8
        np.testing.assert_allclose(back.B / units[:, None], plant.B / units[:, None], atol=1e-7)
        np.testing.assert_allclose(back.C * units, plant.C * units, atol=1e-7)
        np.testing.assert_allclose(back.D, plant.D, atol=1e-7)


@pytest.mark.parametrize("method", ["zoh", "tustin"])
def test_agrees_with_harold(rng, harold, method):
    for _ in range(5):
        a = 0.15 * rng.standard_normal((3, 3)) + 0.6 * np.eye(3)
        plant = ct.ss(a, rng.standard_normal((3, 1)), rng.standard_normal((1, 3)), [[0.3]], 0.1)
        mine = rco.d2c(plant, method)
        state = np.random.get_state()  # noqa: NPY002  harold's logm draws from it
        other = harold.undiscretize(harold.State(plant.A, plant.B, plant.C, plant.D, dt=0.1), method=method)
        np.random.set_state(state)  # noqa: NPY002
        factor = np.ones((4, 4))
        if method == "zoh":
            # harold 1.0.3 balances the block matrix, takes the logarithm of the one that
            # is not balanced, and undoes the balancing all the same: take that factor out.
            block = np.block([[plant.A, plant.B], [np.zeros((1, 3)), np.eye(1)]])
            _, (scale, _) = linalg.matrix_balance(block, permute=False, separate=True)
            factor = scale[:, None] / scale
        theirs = ct.ss(other.a / factor[:3, :3], other.b / factor[:3, 3:], other.c, other.d)
        omega = np.geomspace(0.1, 30, 20)
        np.testing.assert_allclose(mine(1j * omega), theirs(1j * omega), rtol=1e-8)


def test_labels_name_and_timebase():
    plant = ct.ss([[0.9]], [[1.0]], [[1.0]], [[0.0]], 0.1, inputs="w", outputs="y", states="q", name="tank")
    back = rco.d2c(plant)
    assert (back.name, back.dt, back.input_labels, back.output_labels) == ("tank", 0, ["w"], ["y"])
    assert back.state_labels == ["q"]
    assert plant.dt == 0.1
    assert back.A[0, 0] == pytest.approx(np.log(0.9) / 0.1, rel=1e-13)
    assert back.B[0, 0] == pytest.approx(np.log(0.9) / 0.1 / (0.9 - 1), rel=1e-13)


def test_singular_in_continuous_time():
    # Triple integrator beside a lag: a Jordan block at one.
    a = np.zeros((4, 4))
    a[0, 1] = a[1, 2] = 1.0
    a[3, 3] = -5.0
    plant = ct.ss(a, [[0], [0], [1], [1]], [[1, 0, 0, 1]], 0)
    back = rco.d2c(plant.sample(0.1))
    np.testing.assert_allclose(back.A, plant.A, atol=1e-9)
    np.testing.assert_allclose(back.B, plant.B, atol=1e-9)


def test_inputs_in_very_different_units():
    plant = ct.ss([[-1.0, 0.3], [-0.2, -2.0]], [[1e-9, 1e7], [2e-9, -3e6]], np.eye(2), 0)
    back = rco.d2c(plant.sample(0.2))
    np.testing.assert_allclose(back.B, plant.B, rtol=1e-10)
    np.testing.assert_allclose(back.A, plant.A, rtol=1e-10)


@pytest.mark.parametrize("method", ["zoh", "tustin"])
def test_static_gain(method):
    back = rco.d2c(ct.ss([], [], [], [[2.0, 3.0]], 0.1), method)
    assert back.dt == 0
    np.testing.assert_array_equal(back.D, [[2.0, 3.0]])


def test_mode_below_nyquist_is_silent_and_exact():
    omega = 0.85 * np.pi
    plant = ct.ss([[0, 1], [-(omega**2), -0.1 * omega]], [[0], [1]], [[1, 0]], 0)
    np.testing.assert_allclose(rco.d2c(plant.sample(1.0)).A, plant.A, rtol=1e-9, atol=1e-9)


def test_mode_near_nyquist_is_doubted_and_its_frequency_named():
    omega = 0.97 * np.pi
    plant = ct.ss([[0, 1], [-(omega**2), -0.02 * omega]], [[0], [1]], [[1, 0]], 0, name="beam")
    with pytest.warns(rco.ConversionWarning, match=r"'beam' has a mode at 3\.04\d* rad/s") as record:
        rco.d2c(plant.sample(1.0, name="beam"))
    assert record[0].filename == __file__


def test_mode_well_above_nyquist_cannot_be_seen():
    # As the docstring says: folded to 2 pi - omega, and nothing betrays it.
    omega = 1.5 * np.pi
    plant = ct.ss([[0, omega], [-omega, 0]], [[0], [1]], [[1, 0]], 0)
    poles = rco.d2c(plant.sample(1.0)).poles()
    np.testing.assert_allclose(np.sort(np.abs(poles.imag)), [0.5 * np.pi] * 2, rtol=1e-10)


@pytest.mark.parametrize(
    "a",
    [[[0.0]], [[0.0, 1.0], [0.0, 0.0]], [[0.5, 1.0], [1.0, 2.0]], [[1e-18, 0.0], [0.0, 0.9]]],
    ids=["delay", "two delays", "rank", "underflow"],
)
def test_pole_at_zero_has_no_continuous_equivalent(a):
    n = len(a)
    with pytest.raises(rco.ModelError, match="pole at zero"):
        rco.d2c(ct.ss(a, np.ones((n, 1)), np.ones((1, n)), 0, 0.1))


def test_negative_real_pole_has_no_real_logarithm():
    with pytest.raises(rco.ModelError, match=r"pole at -0\.5.*Nyquist frequency 31\.4"):
        rco.d2c(ct.ss([[-0.5, 1.0], [0.0, 0.3]], [[1], [1]], [[1, 0]], 0, 0.1))


def test_pole_at_minus_one_has_no_bilinear_equivalent():
    with pytest.raises(rco.ModelError, match="pole at -1"):
        rco.d2c(ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, 0.1), "tustin")


def test_tustin_takes_the_poles_that_the_hold_refuses():
    plant = ct.ss([[-0.5, 1.0], [0.0, 0.0]], [[1], [1]], [[1, 0]], [[0]], 0.1)
    back = rco.d2c(plant, "tustin")
    again = back.sample(0.1, "tustin")
    np.testing.assert_allclose(again.A, plant.A, atol=1e-12)
    np.testing.assert_allclose(again.C, plant.C, atol=1e-12)


@pytest.mark.parametrize(
    "dt, words", [(0, "continuous already"), (True, "no definite sampling time"), (None, r"dt = None")]
)
def test_timebases_that_cannot_be_converted(dt, words):
    with pytest.raises(rco.ModelError, match=words):
        rco.d2c(ct.ss([[0.5]], [[1.0]], [[1.0]], 0, dt))


def test_wrong_types():
    with pytest.raises(ct.ControlArgument, match="TransferFunction"):
        rco.d2c(ct.tf([1.0], [1.0, 0.5], 0.1))
    with pytest.raises(ct.ControlArgument, match="not 'foh'"):
        rco.d2c(ct.ss([[0.5]], [[1.0]], [[1.0]], 0, 0.1), "foh")
    with pytest.raises(TypeError, match="unexpected keyword"):
        rco.d2c(ct.ss([[0.5]], [[1.0]], [[1.0]], 0, 0.1), mode="zoh")
