"""Tables and pictures: width, escaping, axes, units, and what python-control can do with them."""

from __future__ import annotations

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest
from inner import LinearModel, TextTable, bode_comparison

import rcorefine as rco
from rcorefine import Measurement, compare, physical, refine
from rcorefine.systems.response import as_sampled

DT = 0.1


def lag(tau=0.5, name="lag"):
    return ct.ss([[-1 / tau]], [[1 / tau]], [[1.0]], [[0.0]], inputs="f", outputs="y", name=name)


def resonant(zeta=0.05, name="mode"):
    return ct.ss([[0, 1], [-9, -6 * zeta]], [[0], [9.0]], [[1.0, 0]], [[0.0]], name=name)


def record(system, n=2000, noise=0.02, hold="zoh", **options):
    rng = np.random.default_rng(4)
    w = rng.standard_normal(n)
    t = DT * np.arange(n)
    y = np.array(ct.forced_response(system.sample(DT) if hold == "zoh" else system, t, w).y)
    return Measurement(w, y + noise * y.std() * rng.standard_normal(y.shape), dt=DT, hold=hold, **options)


# ---------------------------------------------------------------------- tables


def test_text_table_is_never_wider_than_asked():
    rows = [["a very long name " * 8, "Q" * 80, "123.4", "-0.000123"]]
    table = TextTable(
        ["model", "output", "fit", "RMSE"], rows, title="T " * 60, notes=["note " * 40], left=2
    ).text()
    assert max(len(line) for line in table.splitlines()) <= 80
    assert "-0.000123" in table
    assert (table.count("very"), table.count("Q")) == (8, 80)  # nothing is cut


def test_text_that_stands_in_every_row_is_told_once_before_names_are_cut(monkeypatch):
    names = ["a name of twenty-four letters", "another of some more letters"]
    rows = [[name, "resistor_voltage", "V", "1.25"] for name in names]
    wide = TextTable(["model", "output", "unit", "fit"], rows, left=3).text()
    monkeypatch.setattr("rcorefine.views.tables.WIDTH", 50)
    lines = TextTable(["model", "output", "unit", "fit"], rows, title="two", left=3).text().splitlines()
    assert lines[:2] == ["two", "output: resistor_voltage, unit: V"]
    assert [line.split("  ")[0] for line in lines[4:]] == names
    assert "output:" not in wide


def test_text_table_columns_line_up():
    lines = TextTable(["m", "fit"], [["a", "1.0"], ["long", "100.0"]]).text().splitlines()
    assert lines == ["m       fit", "----  -----", "a       1.0", "long  100.0"]


def test_html_table_escapes_everything():
    table = TextTable(["<h>"], [["<script>alert('x')</script>"]], "<t>", ["<n> & more"]).html()
    assert "<script>" not in table
    for raw in ("<h>", "<t>", "<n>"):
        assert raw not in table
    assert "&amp; more" in table


def test_comparison_tables_explain_each_figure():
    data = record(resonant(), name="<img src=x>", output_units="m")
    result = compare([lag(), resonant()], data)
    text = str(result)
    assert all(len(line) <= 80 for line in text.splitlines())
    for word in ("bias", "largest", "initial state is estimated", "2000 samples"):
        assert word in " ".join(text.split())
    for word in ("fit =", "RMSE:", "bias", "largest"):
        assert word in result.legend
    assert "<img" not in result._repr_html_()
    assert text.count("\n") < 20


def test_a_result_shown_in_the_console_is_one_line():
    model = physical(resonant())
    data = record(resonant(), n=400)
    for result in (model, data, compare(model, data), refine(model, data, free="linear")):
        assert "\n" not in repr(result)
        assert len(repr(result)) < 120
        assert type(result).__name__ in repr(result)


# ---------------------------------------------------------------------- Bode


def test_as_sampled_is_exact_for_both_holds():
    model = LinearModel.from_statespace(resonant())
    omega = np.linspace(0.5, 30, 40)
    z = np.exp(1j * omega * DT)
    for hold in ("zoh", "foh"):
        seen = as_sampled(model, DT, hold).to_statespace()
        expected = resonant().sample(DT, hold)  # scipy's cont2discrete
        np.testing.assert_allclose(seen(z), expected(z), rtol=1e-9)
    assert as_sampled(model, DT, "bandlimited") is model
    discrete = LinearModel.from_statespace(resonant().sample(DT))
    assert as_sampled(discrete, DT, "foh") is discrete


def test_bode_of_systems_alone_has_two_rows_and_the_right_values():
    cplt = bode_comparison([("initial", resonant(0.05)), ("refined", resonant(0.2))], omega=[1.0, 3.0, 20.0])
    assert cplt.axes.shape == (2, 1)
    line = cplt.lines[0, 0][0]
    np.testing.assert_allclose(line.get_xdata(), [1, 3, 20])
    np.testing.assert_allclose(line.get_ydata(), np.abs(resonant(0.05)(1j * np.array([1, 3, 20]))))
    np.testing.assert_allclose(
        cplt.lines[1, 0][1].get_ydata(), np.degrees(np.angle(resonant(0.2)(1j * np.array([1, 3, 20]))))
    )
    assert [t.get_text() for t in cplt.legend.get_texts()] == ["initial", "refined"]


def test_bode_with_a_record_has_dots_band_and_error_row():
    data = record(resonant())
    cplt = bode_comparison([("wrong", resonant(0.3)), ("true", resonant())], data)
    assert cplt.axes.shape == (3, 1)
    magnitude, phase, error = cplt.axes[:, 0]
    dots = cplt.lines[0, 0][-1]
    assert dots.get_marker() == "."
    assert dots.get_linestyle() == "None"
    assert len(magnitude.collections) == 1
    assert len(error.collections) == 1
    measured = data.frequency_response()
    sampled = resonant(0.3).sample(DT)(np.exp(1j * measured.omega * DT))
    np.testing.assert_allclose(
        cplt.lines[2, 0][0].get_ydata(), np.abs(sampled / measured.response[0, 0] - 1), rtol=1e-8
    )
    assert magnitude.get_xlim()[1] < 1.3 * np.pi / DT
    assert phase.get_ylim() == pytest.approx((-198, 198))


def test_phase_stays_within_180_and_lines_break_where_it_wraps():
    third = lag() * resonant() * lag()
    cplt = bode_comparison([("third", ct.ss(third))], record(ct.ss(third), noise=0.1))
    for line in cplt.lines[1, 0]:
        angle = line.get_ydata()
        assert np.nanmax(np.abs(angle)) <= 180
    line = np.asarray(cplt.lines[1, 0][0].get_ydata())
    jumps = np.abs(np.diff(line))
    assert np.nanmax(jumps) < 180
    assert np.isnan(line).any()


def test_line_styles_tell_curves_apart_without_color():
    cplt = bode_comparison([(f"m{i}", resonant(0.01 * (i + 1))) for i in range(6)])
    styles = {(str(line.get_linestyle()), str(line._dash_pattern)) for line in cplt.lines[0, 0]}
    assert len(styles) == 6
    assert cplt.figure.get_figwidth() == 7


def test_bode_mimo_layout_and_sizes():
    two = ct.ss(-np.eye(2), np.eye(2), [[1.0, 0.2], [0.1, 1.0], [1, 1]], np.zeros((3, 2)))
    assert bode_comparison([("a", two)]).axes.shape == (6, 2)
    with pytest.raises(ct.ControlDimension, match="'b' has 1 outputs and 1 inputs"):
        bode_comparison([("a", two), ("b", lag())])
    with pytest.raises(ValueError, match="nothing to draw"):
        bode_comparison([])
    with pytest.raises(ct.ControlArgument, match="FrequencyResponseData"):
        bode_comparison([("a", ct.frd([1.0, 0.5], [1.0, 2.0]))])
    with pytest.raises(TypeError):
        bode_comparison([("a", two)], colour="red")


def test_bode_follows_python_controls_units():
    data = record(resonant())
    with ct.defaults({"freqplot.dB": True, "freqplot.Hz": True, "freqplot.deg": False}):
        cplt = bode_comparison([("m", resonant())], data, omega=[1.0, 2.0])
    np.testing.assert_allclose(cplt.lines[0, 0][0].get_xdata(), np.array([1.0, 2.0]) / 2 / np.pi)
    expected = 20 * np.log10(np.abs(resonant().sample(DT)(np.exp(1j * np.array([1, 2]) * DT))))
    np.testing.assert_allclose(cplt.lines[0, 0][0].get_ydata(), expected, rtol=1e-8)
    assert "dB" in cplt.axes[0, 0].get_ylabel()
    assert "rad" in cplt.axes[1, 0].get_ylabel()
    assert "Hz" in cplt.axes[-1, 0].get_xlabel()


def test_python_control_can_draw_on_top():
    data = record(resonant())
    cplt = bode_comparison([("m", resonant())], data)
    count = len(cplt.axes[0, 0].lines)
    ct.bode_plot(resonant(0.5).sample(DT, name="more"), ax=cplt.axes[:2], label="more")
    assert len(cplt.axes[0, 0].lines) > count
    measured = data.frequency_response().frd
    ct.bode_plot(measured, ax=cplt.axes[:2], marker=".", linestyle="none", label="again")
    below = ct.bode_plot(resonant())
    assert bode_comparison([("m", resonant())], ax=below.axes).figure is below.figure


def test_a_plain_frd_serves_as_measured_response():
    omega = np.geomspace(0.3, 30, 60)
    analog = ct.frd(resonant()(1j * omega), omega, name="analyzer")
    cplt = bode_comparison([("true", resonant()), ("wrong", resonant(0.3))], analog)
    assert np.max(cplt.lines[2, 0][0].get_ydata()) < 1e-9
    assert "analyzer" in [t.get_text() for t in cplt.legend.get_texts()]
    sampled = record(resonant()).frequency_response().frd
    bode_comparison([("true", resonant())], sampled)
    response = rco.FrequencyResponse.from_frd(sampled)
    assert "not known" in str(response)
    response.plot()
    with pytest.raises(ct.ControlArgument, match="TransferFunction"):
        bode_comparison([("true", resonant())], ct.tf(1, [1, 1]))
    with pytest.raises(ValueError, match="not positive"):
        rco.FrequencyResponse.from_frd(ct.frd([1.0, 1.0], [0.0, 1.0]))


def test_static_and_integrating_and_unstable_models_draw():
    models = [
        ct.ss([], [], [], [[2.0]]),
        ct.ss([[0.0]], [[1.0]], [[1.0]], 0),
        ct.ss([[1.0]], [[1.0]], [[1.0]], 0),
    ]
    bode_comparison([(f"m{i}", m) for i, m in enumerate(models)])
    bode_comparison([(f"m{i}", m) for i, m in enumerate(models)], record(lag()))
    bode_comparison([("d", ct.ss([[0.0]], [[1.0]], [[1.0]], 0, DT))], record(lag()))
    bode_comparison([], record(lag()))


# ---------------------------------------------------------------------- keywords


@pytest.mark.parametrize("kind", ["time", "bode"])
def test_plot_keywords_as_in_python_control(kind):
    result = compare([lag(), resonant()], record(resonant(), name="run $1$"))
    cplt = result.plot(
        kind, label=["A", "B"], title="Title", legend_loc="lower left", rcParams={"font.size": 6}
    )
    assert cplt.figure._suptitle.get_text() == "Title"
    texts = [t.get_text() for t in cplt.legend.get_texts()]
    assert any(t.startswith("A") for t in texts)
    assert result.plot(kind, legend_loc=False).legend is None
    assert result.plot(kind, show_legend=False).legend is None
    assert result.plot(kind, ax=cplt.axes).figure is cplt.figure
    with pytest.raises(ct.ControlDimension, match="ax"):
        result.plot(kind, ax=cplt.axes[:1])
    with pytest.raises(ct.ControlDimension, match="label"):
        result.plot(kind, label="A")
    cplt.figure.canvas.draw()
    with pytest.raises(ct.ControlArgument, match="'time', 'bode'"):
        result.plot("residuals")
    with pytest.raises(TypeError):
        result.plot(kind, colour="red")


def test_time_plot_shows_fit_and_residual():
    result = compare([lag(), resonant()], record(resonant(), name="run"))
    cplt = result.plot()
    texts = [t.get_text() for t in cplt.legend.get_texts()]
    assert texts[0] == "run"
    assert texts[2] == f"mode (fit {result.fit[1, 0]:.1f} %)"
    np.testing.assert_array_equal(cplt.lines[1, 0][0].get_ydata(), result.residual[0, 0])
    with pytest.raises(ct.ControlArgument, match="belongs to kind='bode'"):
        result.plot(omega=[1, 2])


def test_a_long_record_is_shown_where_models_differ_most():
    noise = np.random.default_rng(0).standard_normal(6000)
    plant, late = lag(), np.where(np.arange(6000) < 4000, 0.0, 1.0)
    y = ct.forced_response(plant.sample(0.01), inputs=noise).outputs
    data = Measurement(noise, y - np.convolve(late * noise, [0.5, -0.5])[:6000], dt=0.01)
    cplt = compare(plant, data).plot()
    first, last = cplt.axes[-1, 0].get_xlim()
    assert 40.0 <= first < last <= 60.0
    assert last - first < 20.0
    assert "where they differ most" in cplt.figure.get_suptitle()
    assert all(line.get_xdata().size == 6000 for line in cplt.lines[0, 0])  # the rest is there to be shown
    assert compare(lag(), record(resonant())).plot().axes[-1, 0].get_xlim()[0] < 0.0  # room for all


def test_a_hairball_is_drawn_as_the_band_that_holds_it():
    noise = np.random.default_rng(1).standard_normal(4000)
    cplt = Measurement(noise, noise, dt=0.01).plot()
    (line,), (band,) = cplt.lines[0, 0], cplt.axes[0, 0].collections
    assert not line.get_visible()
    np.testing.assert_array_equal(line.get_ydata(), noise)
    edges = band.get_paths()[0].vertices
    assert edges[:, 1].max() == noise.max()
    assert edges[:, 1].min() == noise.min()
    assert edges[:, 0].min() == 0.0
    assert edges[:, 0].max() == pytest.approx(39.99)


def test_time_plot_keeps_the_record_readable_beside_a_model_that_runs_away():
    far = ct.ss([[0.05]], [[1.0]], [[1.0]], 0, name="far")
    cplt = compare(far, record(lag()), x0="zero").plot()
    low, high = cplt.axes[0, 0].get_ylim()
    data = record(lag()).outputs
    assert high - low < 6 * np.ptp(data)


def test_given_axes_of_a_users_own_figure():
    figure, axes = plt.subplots(2, 1)
    cplt = compare(lag(), record(lag())).plot(ax=axes)
    assert cplt.figure is figure
    assert figure._suptitle is None
