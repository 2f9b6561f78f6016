"""Step, pole and Nyquist pictures of a refinement, and the models drawn for their bands."""

import control as ct
import matplotlib as mpl
import numpy as np
import pytest

import rcorefine as rco
from rcorefine.views.figures import Frame


@pytest.fixture(scope="module")
def better():
    model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    true = rco.mass_spring_damper([1.0], [0.6], [80.0], sensors="displacement")
    rng = np.random.default_rng(0)
    force = rng.standard_normal(600)
    y = rco.simulate(true, rco.Measurement(force, np.zeros(600), dt=0.05), "zero").outputs
    y = y + 0.3 * y.std() * rng.standard_normal(y.shape)
    data = rco.Measurement(force, y, dt=0.05)
    return rco.refine(model, data, [rco.Effect("stiffness", "link1"), rco.Effect("damping", "link1")])


def test_drawn_models_have_the_covariance_of_the_estimates(better):
    """k / m and c / m of the draws; 4 standard errors of a sample covariance of normal numbers."""
    count = 4000
    entries = -np.array([[one.A[1, 0], one.A[1, 1]] for one in better.drawn(count, seed=1)])
    values = np.array([row.value for row in better.parameters if row.role == "effect"])
    free = [i for i, row in enumerate(better.parameters) if row.role == "effect"]
    C = better.covariance[np.ix_(free, free)]
    sd = np.sqrt(np.diag(C))
    assert (np.abs(entries.mean(axis=0) - values) < 4 * sd / np.sqrt(count)).all()
    spread = 4 * np.sqrt((C**2 + np.outer(sd, sd) ** 2) / count)
    assert (np.abs(np.cov(entries.T) - C) < spread).all()
    for first, again in zip(better.drawn(3), better.drawn(3), strict=True):
        np.testing.assert_array_equal(first.A, again.A)


def test_the_pictures_show_the_systems(better):
    steps = better.response_plot("step", count=50)
    times, y = steps.lines[0, 0][1].get_data()
    np.testing.assert_allclose(y, ct.step_response(better.system, times).outputs, atol=1e-12)
    poles = better.response_plot("poles", count=20)
    drawn = poles.lines[0, 0][2].get_data()
    shown = np.sort_complex(drawn[0] + 1j * drawn[1])
    np.testing.assert_allclose(shown, np.sort_complex(better.system.poles()))
    nyquist = better.response_plot("nyquist", count=20)
    re, im = nyquist.lines[0, 0][1].get_data()
    assert np.abs(re + 1j * im).max() == pytest.approx(
        np.abs(better.system(1j * np.linspace(5, 12, 20000))).max(), rel=1e-2
    )
    with pytest.raises(ct.ControlArgument, match="kind"):
        better.response_plot("root locus")


def test_the_bode_plot_has_a_band(better):
    omega = np.array([2.0, 9.0, 20.0])
    shown = better.bode_plot(omega=omega)
    assert any(len(ax.collections) for ax in shown.axes.flat)


def test_a_notebook_goes_on_to_show_figures():
    """Its backend turns the interactive mode on when the first figure loads it, within our settings."""
    before = mpl.is_interactive()
    try:
        mpl.interactive(False)
        with Frame().settings():
            mpl.interactive(True)
        assert mpl.is_interactive()
    finally:
        mpl.interactive(before)
