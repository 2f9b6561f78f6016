"""`check`: what was put into a record is found, and nothing is found in a clean one."""

from __future__ import annotations

import dataclasses
import json

import control as ct
import numpy as np
import pytest
from hidden.wider import wider_record
from inner import main
from scipy.signal import butter, lfilter

import rcorefine as rco
from rcorefine.diagnosis.check_rows import warned

DT, N = 0.02, 2000
MODEL = ct.ss([[0, 1], [-40, -2]], [[0], [40]], [[1, 0]], [[0]], inputs=["u"], outputs=["y"])


def outputs(w: np.ndarray) -> np.ndarray:
    return ct.forced_response(MODEL.sample(DT), np.arange(w.size) * DT, w).outputs


def drive(seed: int = 0, n: int = N) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).standard_normal(n // 5), 5)


def look(w, y, model=MODEL, **options) -> dict[str, rco.CheckRow]:
    found = rco.check(
        model, rco.Measurement(w, y, dt=DT, input_labels="u", output_labels="y"), information=False
    )
    return {row.what: row for row in found.looks}


def noisy(w, seed=1, share=0.02):
    y = outputs(w)
    return y + share * y.std() * np.random.default_rng(seed).standard_normal(y.size)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", ["chain", "servo", "motor", "half car", "RC ladder", "thermal", "pendulum"])
@pytest.mark.parametrize("how", ["steady", "steps", "prbs", "multisine"])
def test_clean_records_pass(name, how, seed):
    record = wider_record(700 + seed, plant=name, kind=None, drive_kind=how, samples=1000)
    assert rco.check(record.plant.model, record.data, information=False).looks == ()


@pytest.mark.parametrize(
    ("factor", "what", "status", "words"),
    [
        (60 / (2 * np.pi), "units", "stop", "rpm where the model has rad/s"),
        (2 * np.pi / 60, "units", "stop", "rad/s where the model has rpm"),
        (180 / np.pi, "units", "stop", "degrees where the model has radians"),
        (9.80665, "units", "stop", "m/s^2 where the model has g"),
        (1 / 25.4, "units", "stop", "inches where the model has millimeters"),
        (1e-3, "units", "stop", "units where the model has thousandths"),
        (1.13 * 180 / np.pi, "units", "look", "degrees"),  # beside parameters that are off
        (-1e3, "sign", "stop", "thousandths"),
        (1.3, "gain", "look", "a wrong gain or parameter value"),
    ],
)
def test_size(factor, what, status, words):
    w = drive()
    row = look(w, factor * noisy(w))[what]
    assert row.status == status
    assert words in row.sentence


def test_a_small_change_of_the_gain_is_none():
    w = drive()
    assert "gain" not in look(w, 1.01 * noisy(w))


ROTOR = ct.ss([[-2]], [[30]], [[1]], [[0]], inputs=["u"], outputs=["speed"])


def spun(gain=1.0, drag=0.0, noise=0.02, seed=2):
    """Speed of a rotor with a drag that grows with the square of it, by small Euler steps."""
    w, x, run = drive(seed), 0.0, []
    for value in w:
        run.append(x)
        for _ in range(20):
            x += DT / 20 * (30 * gain * value - 2 * x - drag * x * abs(x))
    y = np.array(run)
    return w, y + noise * y.std() * np.random.default_rng(seed + 9).standard_normal(y.size)


def unit_rows(w, y, model=ROTOR, **units):
    data = rco.Measurement(w, y, dt=DT, input_labels="u", output_labels="speed", **units)
    return [row for row in rco.check(model, data, information=False).looks if row.what in ("units", "gain")]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("gain", [6.35, 9.7, 55.0])
def test_a_gain_near_a_unit_is_no_unit_for_certain(gain, seed):
    (row,) = unit_rows(*spun(gain, seed=seed))
    assert row.status == "look"
    assert "a wrong gain or parameter value" in row.sentence
    assert "m/s^2" not in row.sentence


@pytest.mark.parametrize("drag", [0.1, 0.3])
def test_a_unit_beside_a_law_that_is_missing_is_one_of_several_words(drag):
    w, y = spun(drag=drag)
    (row,) = unit_rows(w, y * 30 / np.pi)
    assert row.status == "look"
    assert "rpm where the model has rad/s" in row.sentence
    assert "m/s^2" not in row.sentence


def test_declared_units_are_certain_and_are_converted_in_one_line():
    w, y = spun(drag=0.1)
    model = rco.physical(ROTOR, units={"speed": "rad/s"})
    (row, *_) = unit_rows(w, y * 30 / np.pi, model, output_units="rpm")
    assert (row.status, row.what) == ("stop", "units")
    line = row.sentence.split("convert it: ")[1].removesuffix(".")
    data = rco.Measurement(w, y * 30 / np.pi, dt=DT, output_labels="speed", output_units="rpm")
    known = {"data": data, "dataclasses": dataclasses}
    exec(line, known)
    np.testing.assert_allclose(known["data"].outputs[0], y, rtol=1e-5)
    assert known["data"].output_units == ("rad/s",)
    # the header may be what is wrong
    w, y = spun()
    (row,) = unit_rows(w, y, model, output_units="rpm")
    assert row.status == "look"
    assert "one unit is declared wrong" in row.sentence
    # and where the same unit is declared twice, nothing is to be converted
    assert unit_rows(w, y, model, output_units="rad/s") == []
    (row,) = unit_rows(w, y * 1e3, rco.physical(ROTOR, units={"speed": "V"}), output_units="mV")
    assert "data.outputs * 0.001" in row.sentence


def test_the_header_of_a_file_tells_its_unit(tmp_path):
    w, y = spun()
    rows = [f"{k * DT:.2f},{a:.6g},{b:.6g}" for k, (a, b) in enumerate(zip(w, y, strict=True))]
    (tmp_path / "r.csv").write_text("\n".join(["time [s],u [N m],speed [rpm]", *rows]))
    model = rco.physical(ROTOR, units={"speed": "rad/s", "u": "N m"})
    data = rco.read_record(tmp_path / "r.csv", model)
    assert (data.output_units, data.input_units) == (("rpm",), ("N m",))


def test_a_converter_and_fast_transients_are_no_spikes():
    w = np.repeat(np.random.default_rng(8).standard_normal(N // 200), 200)
    y = outputs(w)
    wrong = ct.ss([[0, 1], [-44, -2]], [[0], [40]], [[1, 0]], [[0]])
    assert "spikes" not in look(w, np.round(y / 0.002) * 0.002, wrong)


def test_delay_and_lead():
    w = drive()
    assert look(w, np.roll(noisy(w), 7))["delay"].figure == "7 samples, 0.14 s"
    assert "ahead" in look(w, np.roll(noisy(w), -7))["delay"].sentence


def test_a_level_that_the_model_does_not_explain():
    """Its standard error is that of a mean: white noise of 2 %, so a colored one may only be larger."""
    w = drive()
    y = noisy(w)
    row = look(w, y + 1.25 * y.std())["level"]
    value, error = map(float, row.figure.split(" +/- "))
    assert abs(value - 1.25 * y.std()) < 4 * error
    assert error == pytest.approx(0.02 * y.std() / np.sqrt(N), rel=0.25)
    assert "level" not in look(w, y)
    data = rco.Measurement(w + 2.0, noisy(w + 2.0), dt=DT, input_labels="u", output_labels="y")
    stands = rco.check(MODEL, data, information=False)
    (level,) = [row for row in stands.rows if row.what == "level"]
    assert (level.status, level.figure) == ("ok", "by the model")


def test_offset_drift_spikes_dropouts_clipping_steps():
    w, rng = drive(), np.random.default_rng(3)
    y = noisy(w)
    assert "operating point" in look(w, y + 24.0)["level"].sentence
    assert look(w, y + 2.0 * y.std() * np.linspace(-0.5, 0.5, N))["drift"].status == "look"
    spiky = y.copy()
    spiky[rng.permutation(N)[:20]] += 5 * y.std()
    assert look(w, spiky)["spikes"].status == "look"
    lost = y + 3.0
    lost[500:504] = lost[900:903] = 0.0
    assert look(w, lost)["dropouts"].figure == "2 samples read 0" or "dropouts" in look(w, lost)
    assert look(w, np.minimum(y, 0.8 * y.max()))["clipping"].status == "look"
    assert look(w, np.round(outputs(w) / (0.3 * y.std())) * 0.3 * y.std())["resolution"].status == "look"


def test_constant_repeated_and_one_sided_signals():
    w = drive()
    y = noisy(w)
    two = ct.ss([[-1.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]], inputs=["u", "v"], outputs=["y"])
    found = rco.check(two, rco.Measurement(np.array([w, 2 * w + 1]), y, dt=DT), information=False)
    assert any(row.what == "repeated" for row in found.looks)
    found = rco.check(two, rco.Measurement(np.array([w, 0 * w]), y, dt=DT), information=False)
    assert [row.where for row in found.looks if row.what == "motion"] == ["u[1]"]
    assert look(np.abs(w) + 0.5, noisy(np.abs(w) + 0.5))["sign"].status == "look"


@pytest.mark.parametrize("seed", range(5))
def test_closed_loop(seed):
    """u(k) = r(k) - 2 y(k) with process noise: seen; the same inputs played open loop: not."""
    rng = np.random.default_rng([seed, 5])
    d = MODEL.sample(DT)
    r, x, u, y = rng.standard_normal(N), np.zeros(2), np.zeros(N), np.zeros(N)
    for k in range(N):
        y[k] = (d.C @ x)[0] + 0.2 * rng.standard_normal()
        u[k] = r[k] - 2 * y[k]
        x = d.A @ x + d.B[:, 0] * (u[k] + 0.3 * rng.standard_normal())
    assert "closed loop" in look(u, y)
    assert "closed loop" not in look(u, outputs(u) + 0.2 * rng.standard_normal(N))


def test_sampling_length_and_stability():
    w = drive()
    fast = ct.ss([[0, 1], [-(200.0**2), -4]], [[0], [1]], [[1, 0]], [[0]])
    assert "lie above half" in look(w, w, fast)["sampling"].sentence
    slow = ct.ss([[-0.001]], [[1.0]], [[1.0]], [[0.0]])
    assert look(w, np.cumsum(w) * DT, slow)["length"].status == "look"
    assert "horizon" in look(w, w, ct.ss([[0.3]], [[1.0]], [[1.0]], [[0.0]]))["stability"].sentence


def test_information_says_what_would_be_seen():
    """One standard deviation of a gain is that of least squares; 95 % needs the level and 1.645 more."""
    w = drive()
    data = rco.Measurement(w, noisy(w), dt=DT, input_labels="u", output_labels="y")
    found = rco.check(MODEL, data)
    smallest = next(d.smallest for d in found.detectable if d.effect.kind == "input_gain")
    run = outputs(w)
    std = 0.02 * run.std() / np.linalg.norm(run - run.mean())
    assert 4 * std < smallest < 8 * std
    assert found.to_dict()["rows"][0]["status"] == "ok"
    assert "that it would show" in str(found)


def test_what_is_odd_takes_three_lines_above_an_answer():
    rows = [rco.CheckRow("look", f"thing {i}", "y", f"{i}", "word " * (5 + 40 * (i == 0))) for i in range(9)]
    assert warned([]) == []
    said = warned(rows)
    assert len(said) == 2
    assert sum(map(len, said)) < 240
    assert "thing 0" in said[0]
    assert "thing 4 of y and 4 more (see .checks)" in said[1]


def test_bad_arguments():
    with pytest.raises(rco.DataError, match="too short"):
        rco.check(MODEL, rco.Measurement(drive()[:3], drive()[:3], dt=DT))
    with pytest.raises(ct.ControlArgument, match="data must be"):
        rco.check(MODEL, np.zeros(3))
    with pytest.raises(ct.ControlArgument, match="information"):
        rco.check(MODEL, rco.Measurement(drive(), drive(), dt=DT), information="no")


def test_the_command(tmp_path, capsys):
    assert main(["example", "--write", str(tmp_path)]) == 0
    capsys.readouterr()
    model, record = tmp_path / "mass_spring_damper.toml", tmp_path / "mass_spring_damper.csv"
    assert main(["check", str(model), str(record), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["what"] for row in found["rows"]} >= {"gain", "sampling"}
    assert found["detectable"]


def test_a_gain_without_states():
    w = drive()
    found = look(w, 3.0 * w + 0.01 * np.random.default_rng(4).standard_normal(N), ct.ss([], [], [], [[2.0]]))
    assert float(found["gain"].figure.split(" +/- ")[0]) == pytest.approx(1.5, abs=5e-4)


def test_a_diagnosis_says_first_what_is_odd():
    w = drive()
    y = noisy(w)
    data = rco.Measurement(w, np.minimum(y, 0.5 * y.max()), dt=DT, input_labels="u", output_labels="y")
    laws = [rco.Effect("output_saturation", "y"), rco.Effect("output_gain", "y")]
    found = rco.diagnose(MODEL, [data, data.segment(0, 20)], candidates=laws)
    clipped = [row for row in found.checks if row.what == "clipping"]
    assert [row.where for row in clipped] == ["y, record 1", "y, record 2"]
    lines = str(found).splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("LOOK: record 1: y stays at exactly"))
    assert lines[0] == f"Diagnosis: {found.verdict.upper()}"
    assert " ".join(lines[1:first]) == found.sentences()[0]  # the answer comes before
    assert not any("stays at exactly" in note for note in found.notes)
    quiet = rco.diagnose(MODEL, rco.Measurement(w, y, dt=DT), candidates=laws[1:])
    assert quiet.checks == ()
    ladder = rco.improve(MODEL, data, candidates=laws)
    assert [row.what for row in ladder.checks].count("clipping") == 1
    assert "stays at exactly" in str(ladder).splitlines()[1]


def test_a_smooth_error_has_no_spikes():
    slow = ct.ss([[0, 1], [-9, -0.4]], [[0], [6]], [[1, 0]], [[0]])
    fast = ct.ss([[0, 1], [-8, -0.4]], [[0], [6]], [[1, 0]], [[0]])
    w = np.random.default_rng(0).standard_normal(2000)
    y = ct.forced_response(fast.sample(0.05), np.arange(2000) * 0.05, w).outputs
    y = y + 0.02 * y.std() * np.random.default_rng(1).standard_normal(2000)
    found = rco.check(slow, rco.Measurement(w, y, dt=0.05), information=False)
    assert "spikes" not in [row.what for row in found.looks]


@pytest.mark.parametrize("seed", range(4))
def test_a_slow_actuator_is_no_unit_and_no_sign(seed):
    w = np.random.default_rng([seed, 4]).standard_normal(400).repeat(5)
    late = ct.forced_response(ct.tf([1], [0.3, 1]), np.arange(w.size) * DT, w).outputs
    slow = ct.forced_response(MODEL, np.arange(w.size) * DT, late).outputs
    rows = look(w, slow + 0.02 * slow.std() * np.random.default_rng(seed).standard_normal(w.size))
    assert not {"units", "sign"} & set(rows)


def test_a_lag_makes_no_swapped_wire():
    """A quarter of a period late, a sine is as much ahead with the other sign: the sign is not known."""
    t, period = DT * np.arange(N), 50 * DT
    static = ct.ss([], [], [], [[1.0]], inputs=["u"], outputs=["y"])
    w = np.sin(2 * np.pi * t / period)
    for late in (0.2, 0.24, 0.27):
        y = np.sin(2 * np.pi * (t / period - late)) + 0.02 * np.random.default_rng(1).standard_normal(N)
        rows = look(w, y, static)
        assert rows
        assert not [row for row in rows.values() if row.status == "stop"]
    assert look(w, 0.02 * np.random.default_rng(1).standard_normal(N) - w, static)["sign"].status == "stop"


@pytest.mark.parametrize("size", [0.0, 1e-18, 1e-15])
@pytest.mark.parametrize("constant", [0.0, 1.0])
def test_without_motion_of_the_input_no_gain_and_no_delay_is_read(size, constant):
    w = constant + size * drive()
    y = ct.forced_response(MODEL.sample(DT), np.arange(N) * DT, np.full(N, constant), [1.0, 0.0]).outputs
    rows = look(w, y + 0.01 * np.random.default_rng(1).standard_normal(N))
    assert not {"gain", "delay", "sign", "units"} & {what for what, row in rows.items() if row.where == "y"}


TANK = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["u"], outputs=["y"])


@pytest.mark.parametrize("level", [0.0, 1.5, 50.0])
def test_an_integrator_stands_anywhere(level):
    """An initial state holds any level, so none tells a record above a point from an absolute one."""
    w = drive()
    y = level + np.cumsum(w) * DT - w * DT + 0.02 * np.random.default_rng(2).standard_normal(N)
    about = rco.physical(TANK, operating_point={"inputs": [0.0], "states": [5.0], "outputs": [5.0]})
    for model in (TANK, about):
        assert not {"level", "offset", "gain"} & set(look(w, y, model))


def test_a_level_belongs_to_its_output_in_any_order():
    w = drive()
    two = ct.ss(np.diag([-1.0, -2.0]), [[1.0], [1.0]], np.eye(2), 0, inputs=["u"], outputs=["y", "z"])
    point = {"inputs": [0.0], "states": [5.0, 0.0], "outputs": [5.0, 0.0]}
    y = ct.forced_response(two.sample(DT), np.arange(N) * DT, w).outputs
    data = rco.Measurement(w, y[::-1], dt=DT, input_labels="u", output_labels=["z", "y"])
    found = rco.check(rco.physical(two, operating_point=point), data, information=False)
    assert [row.where for row in found.looks if row.what == "level"] == ["y"]


def test_one_level_is_said_once():
    w = drive()
    y = noisy(w)
    rows = rco.check(MODEL, rco.Measurement(w, y + 1.25 * y.std(), dt=DT), information=False).looks
    assert [row.what for row in rows] == ["level"]
    two = ct.ss(MODEL.A, MODEL.B, np.eye(2), 0)
    both = ct.forced_response(two.sample(DT), np.arange(N) * DT, w).outputs
    both = both + both.std(axis=1, keepdims=True) * np.random.default_rng(1).normal(
        [[1.0], [2.0]], 0.02, (2, N)
    )
    rows = rco.check(two, rco.Measurement(w, both, dt=DT), information=False).looks
    assert [(row.what, row.where) for row in rows] == [("level", "y[0]"), ("level", "y[1]")]


@pytest.mark.parametrize("step", [0.5, 0.36])
def test_few_levels_are_said_however_fast_the_signal(step):
    """An output that moves as fast as white noise: its steps are no larger than what it does anyway."""
    w = np.random.default_rng(5).standard_normal(N)
    static = ct.ss([], [], [], [[2.0]], inputs=["u"], outputs=["y"])
    y = 2 * w + 0.02 * np.random.default_rng(6).standard_normal(N)
    coarse = np.round(y / (step * y.std())) * step * y.std()
    row = look(w, coarse, static)["resolution"]
    assert row.figure.startswith(f"{np.unique(coarse).size} levels")
    assert "resolution" not in look(w, y, static)
    assert "resolution" not in look(w, np.round(y / (0.02 * y.std())) * 0.02 * y.std(), static)


@pytest.mark.parametrize("shape", [np.abs, lambda y: np.maximum(y, 0.0), lambda y: np.minimum(y, 0.0)])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_rectified_output(shape, noise):
    w = drive()
    y = shape(noisy(w))
    rows = look(w, y + noise * y.std() * np.random.default_rng(3).standard_normal(N))
    assert set(rows) == {"rectified"}
    assert "never changes sign" in rows["rectified"].sentence


def test_an_absolute_output_is_not_rectified():
    w = drive()
    assert set(look(w, noisy(w) + 4.0)) == {"level"}
    position = np.cumsum(w) * DT - w * DT  # of an integrator, which begins where the record does
    assert not look(w, position - position.min() + 0.01 * np.random.default_rng(1).standard_normal(N), TANK)


SLIDE = ct.ss([[0, 1], [-2, -4]], [[0], [40]], [[1, 0]], [[0]], inputs=["u"], outputs=["y"])


def stopped(w, limit):
    """A slide between two stops that do not throw it back, by small Euler steps."""
    x, v, run = 0.0, 0.0, []
    for value in w:
        run.append(x)
        for _ in range(20):
            x, v = x + DT / 20 * v, v + DT / 20 * (40 * value - 2 * x - 4 * v)
            if abs(x) > limit:
                x, v = np.sign(x) * limit, 0.0
    return np.array(run)


def test_a_record_that_dwells_at_both_ends():
    w = np.repeat(np.random.default_rng(4).standard_normal(N // 25), 25)
    free = stopped(w, np.inf)
    noise = 0.01 * free.std() * np.random.default_rng(1).standard_normal(N)
    rows = look(w, stopped(w, 0.6 * free.std()) + noise, SLIDE)
    assert set(rows) == {"stops"}
    assert "stops" not in look(w, free + noise, SLIDE)
    # where the input dwells, what settles dwells too, however slow the model
    square = np.repeat(np.random.default_rng(5).choice([-1.0, 1.0], N // 100), 100)
    fast = ct.forced_response(ct.tf([1], [0.1, 1]), np.arange(N) * DT, square).outputs
    assert "stops" not in look(square, fast + 0.01 * noise, ct.ss([[-0.5]], [[0.5]], [[1.0]], [[0.0]]))


def test_what_the_verdict_explains_is_not_printed_with_it():
    """A gain that is named is no warning beside its name; it stays in `checks`."""
    w = drive()
    data = rco.Measurement(w, 1.3 * noisy(w), dt=DT, input_labels="u", output_labels="y")
    found = rco.diagnose(MODEL, data, candidates=[rco.Effect("output_gain", "y")])
    assert found.verdict == "parameters"
    assert found.refine().system.dcgain() == pytest.approx(1.3 * MODEL.dcgain(), rel=0.02)
    assert [row.what for row in found.checks] == ["gain"]
    assert "LOOK" not in str(found)
    rows = [rco.CheckRow("look", what, "y", "1", f"{what}.") for what in ("gain", "clipping", "resolution")]
    rows.append(rco.CheckRow("stop", "units", "y", "1", "units."))
    assert [line.split(": ")[0] for line in warned(rows, True, ["y"])] == ["LOOK", "STOP"]
    assert warned(rows, True, ["y"])[0] == "LOOK: resolution."
    assert "clipping" in warned(rows, True)[0]
    assert "gain" in warned(rows)[0]


# ------------------------------------------------------------ nothing is said that the data do not show
def converted(y, bits):
    step = 2 * np.abs(y).max() / 2**bits
    return np.round(y / step) * step


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("period", [7.3, 8, 12])
def test_a_converter_shows_zero_crossings_as_zero_and_loses_nothing(period, bits):
    w = np.sin(2 * np.pi * np.arange(N) / period)
    y = converted(outputs(w), bits)
    assert "dropouts" not in look(w, y)
    top = 700 + int(np.argmax(y[700:730]))
    y[top - 1 : top + 2] = 0.0
    assert look(w, y)["dropouts"].figure == "3 samples read 0"


@pytest.mark.parametrize("bits", [6, 8, 12])
@pytest.mark.parametrize("shape", ["band", "rectified", "dead zone", "ringing", "steps"])
def test_fast_signals_that_pass_or_rest_at_zero_lose_nothing(shape, bits):
    rng, t = np.random.default_rng(0), np.arange(N)
    sine = np.sin(2 * np.pi * t / 15.3)
    ring = np.exp(-np.arange(200) / 25) * np.sin(2 * np.pi * np.arange(200) / 7)
    y = {
        "band": lfilter(*butter(4, 0.5), rng.standard_normal(N)),
        "rectified": np.abs(np.sin(2 * np.pi * t / 12)).round(12),
        "dead zone": sine - np.clip(sine, -0.3, 0.3),
        "ringing": np.tile(ring, N // 200),
        "steps": np.repeat(rng.integers(-3, 4, N // 20), 20).astype(float),
    }[shape]
    assert "dropouts" not in look(drive(), converted(y, bits))


@pytest.mark.parametrize("samples", [1, 4, 30])
def test_lost_samples_are_counted(samples):
    w = drive()
    y = converted(noisy(w) + 3.0, 12)
    for start in (400, 900, 1500):
        y[start : start + samples] = 0.0
    assert look(w, y)["dropouts"].figure == f"{3 * samples} samples read 0"


def tank(drop, seed):
    """A tank with outflow sqrt(h) near the level 2, by small Euler steps; inflow and level are absolute."""
    rng, q0 = np.random.default_rng(seed), np.sqrt(2.0)
    q, h, run = q0 * (1 - drop) + np.repeat(rng.uniform(-0.45, 0.45, 50), 40), 2.0, []
    for value in q:
        run.append(h)
        for _ in range(10):
            h += 0.05 * (value - np.sqrt(h))
    linear = ct.ss([[-0.5 / q0]], [[1.0]], [[1.0]], 0, inputs="q", outputs="h", states=["h"])
    model = rco.physical(linear, operating_point={"inputs": [q0], "states": [2.0], "outputs": [2.0]})
    return model, q, np.array(run) + 0.01 * rng.standard_normal(N)


@pytest.mark.parametrize("seed", range(3))
def test_an_absolute_record_between_zero_and_its_point_holds_no_deviations(seed):
    """Its mean is under three spreads from zero, and under one from the point."""
    model, q, h = tank(0.12, seed)
    assert abs(h.mean() - 2.0) < h.std()
    assert h.mean() < 3.0 * h.std() < 2.0
    labels = {"input_labels": "q", "output_labels": "h"}
    (level,) = [
        r for r in rco.check(model, rco.Measurement(q, h, dt=0.5, **labels)).rows if r.what == "level"
    ]
    assert "deviations" not in level.sentence
    data = rco.Measurement(q - np.sqrt(2.0), h - 2.0, dt=0.5, **labels)
    (level,) = [row for row in rco.check(model, data).rows if row.what == "level"]
    assert "nearer to zero than to the operating point" in level.sentence


@pytest.mark.parametrize("drag", [0.03, 0.1, 0.3])
def test_a_missing_law_is_no_gain_and_no_unit(drag):
    """All parameters are exact; the response is smaller because the drag grows with the speed."""
    (row,) = unit_rows(*spun(drag=drag))
    assert "missing effect" in row.sentence
    assert "wrong gain" not in row.sentence
    assert "unit" not in row.sentence
    (row,) = unit_rows(*spun(gain=0.8))
    assert "a wrong gain or parameter value, a missing effect, or a unit" in row.sentence


@pytest.mark.parametrize("seed", range(2))
def test_a_shaker_that_its_plant_acts_back_on_is_no_controller(seed):
    """Force = Bl/R (voltage - Bl speed): no controller, yet the force follows the noisy motion."""
    rng, d = np.random.default_rng([seed, 8]), MODEL.sample(DT)
    volts, x, force, y = 2 * rng.standard_normal(N), np.zeros(2), np.zeros(N), np.zeros(N)
    for k in range(N):
        y[k] = (d.C @ x)[0]
        force[k] = volts[k] - 0.5 * x[1]
        x = d.A @ x + d.B[:, 0] * (force[k] + 2 * rng.standard_normal())
    said = look(force, y + 0.01 * y.std() * rng.standard_normal(N))["closed loop"].sentence
    assert "a controller acts" not in said
    assert "acts back on its actuator" in said


def test_no_sign_of_a_controller_is_not_an_open_loop():
    """A PI controller, a set point in steps and a quiet sensor: what comes back is too small to see."""
    rng, d = np.random.default_rng(3), MODEL.sample(DT)
    wanted, x, u, y, total = (
        np.repeat(rng.standard_normal(N // 100), 100),
        np.zeros(2),
        np.zeros(N),
        np.zeros(N),
        0.0,
    )
    for k in range(N):
        y[k] = (d.C @ x)[0] + 0.007 * rng.standard_normal()
        total += DT * (wanted[k] - y[k])
        u[k] = 0.2 * (wanted[k] - y[k]) + 0.5 * total
        x = d.A @ x + d.B[:, 0] * u[k]

    def loop(u, y):
        data = rco.Measurement(u, y, dt=DT, input_labels="u", output_labels="y")
        (row,) = [row for row in rco.check(MODEL, data, information=False).rows if row.what == "closed loop"]
        return row

    row = loop(u, y)
    assert (row.status, row.figure) == ("ok", "no sign")
    assert "No sign of a controller in this record" in row.sentence
    sine = np.sin(2 * np.pi * np.arange(N) / 40)
    assert loop(sine, noisy(sine)).figure == "not tested"
