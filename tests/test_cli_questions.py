"""`rcorefine bode`, `refine`, `localize`; pictures and decimal commas."""

from __future__ import annotations

import csv
import json
import re

import control as ct
import numpy as np
import pytest
from inner import main

import rcorefine as rco

MODEL = """\
[mass_spring_damper]
m = [1.0, 0.8]
c = [0.5, 0.4]
k = [{k1}, 150.0]
sensors = [["velocity", 1], ["velocity", 2]]
"""
SIGNATURES = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A model, the plant (its first spring a tenth softer), and a record of that by python-control."""
    at = tmp_path_factory.mktemp("files")
    (at / "model.toml").write_text(MODEL.format(k1=200.0))
    (at / "plant.toml").write_text(MODEL.format(k1=180.0))
    rng = np.random.default_rng(0)
    force = rng.standard_normal(1500)
    plant = rco.read_model(at / "plant.toml").system
    y = ct.forced_response(plant.sample(0.02), inputs=force).outputs
    y = y + 0.01 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    table = np.column_stack([0.02 * np.arange(1500), force, *y])
    names = "time", "force", *plant.output_labels
    np.savetxt(at / "record.csv", table, delimiter=",", header=",".join(names), comments="")
    rows = [";".join(f"{x:.6f}".replace(".", ",") for x in row) for row in table]
    (at / "comma.csv").write_text("\n".join([";".join(names), *rows]) + "\n")
    return at


def run(capsys, *words):
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    assert not captured.err
    return code, captured.out


def rows_of(path, delimiter=","):
    with path.open(newline="") as file:
        return list(csv.DictReader(file, delimiter=delimiter))


def test_bode_of_two_models_and_a_record(files, tmp_path, capsys):
    picture, table = tmp_path / "bode.png", tmp_path / "data.csv"
    words = (files / "model.toml", files / "plant.toml", files / "record.csv")
    code, out = run(capsys, "bode", *words, "--picture", picture, "--csv", table)
    assert code == 0
    assert picture.read_bytes().startswith(SIGNATURES[".png"])
    rows = rows_of(table)
    assert {row["curve"] for row in rows} == {"model", "plant", "measured"}
    # beside a record a model is drawn sampled with its hold: python-control's zero-order hold
    sampled = rco.read_model(files / "plant.toml").system.sample(0.02)
    drawn = [row for row in rows if row["curve"] == "plant"]
    for row in drawn[:: len(drawn) // 20]:
        i = sampled.output_labels.index(row["output"])
        value = sampled(np.exp(1j * 0.02 * float(row["omega"])))[i, 0]
        assert float(row["magnitude"]) == pytest.approx(abs(value), rel=1e-6)
        turned = np.exp(1j * np.radians(float(row["phase_deg"]))) / (value / abs(value))
        assert abs(turned - 1) < 1e-6
    off = {line.split(",")[0]: line for line in out.splitlines() if "velocity" in line or "v1" in line}
    assert "differs by" in off["plant"]


def test_bode_without_a_record_is_continuous(files, tmp_path, capsys):
    table = tmp_path / "data.csv"
    code, _ = run(capsys, "bode", files / "model.toml", "--csv", table, "--decimal", ",")
    assert code == 0
    rows = rows_of(table, ";")
    system = rco.read_model(files / "model.toml").system
    row = rows[len(rows) // 3]
    number = {key: float(row[key].replace(",", ".")) for key in ("omega", "magnitude")}
    i = system.output_labels.index(row["output"])
    assert number["magnitude"] == pytest.approx(abs(system(1j * number["omega"])[i, 0]), rel=1e-6)


def test_bode_as_json_and_what_it_refuses(files, tmp_path, capsys):
    _, out = run(capsys, "bode", files / "model.toml", files / "record.csv", "--json")
    content = json.loads(out)
    assert {curve["curve"] for curve in content["curves"]} == {"model", "measured"}
    assert main(["bode", str(files / "record.csv")]) == 2
    assert "at least one model" in capsys.readouterr().err
    assert main(["bode", str(files / "model.toml"), "--csv", str(tmp_path / "no" / "data.csv")]) == 2
    assert "does not exist" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        main(["bode", str(files / "model.toml"), "--picture", "bode.bmp"])
    assert end.value.code == 2


@pytest.mark.parametrize("suffix", SIGNATURES)
def test_refine_and_its_picture(files, tmp_path, capsys, suffix):
    picture = tmp_path / f"refined{suffix}"
    words = ("--effects", "stiffness@link1", "--picture", picture, "--json")
    code, out = run(capsys, "refine", files / "model.toml", files / "record.csv", *words)
    content = json.loads(out)
    assert code == content["exit_code"] == 0
    row = next(row for row in content["parameters"] if row["place"] == "link1")
    assert row["coefficient"] == pytest.approx(-20.0, abs=4 * row["std"])
    assert picture.read_bytes().startswith(SIGNATURES[suffix])


def test_localize_names_the_spring(files, tmp_path, capsys):
    picture = tmp_path / "map.png"
    code, out = run(capsys, "localize", files / "model.toml", files / "record.csv", "--picture", picture)
    assert code == 1
    lost = re.search(r"link1 lost ([\d.]+) \+/- ([\d.]+) %", " ".join(out.split()))
    assert abs(float(lost[1]) - 10.0) < 2 * float(
        lost[2]
    )  # of 200 N/m 20 are gone; the interval is one of 95 %
    assert picture.read_bytes().startswith(SIGNATURES[".png"])
    code, out = run(capsys, "localize", files / "plant.toml", files / "record.csv", "--json")
    assert code == 0
    assert not any(row["named"] for row in json.loads(out)["rows"])


def test_pictures_of_the_other_questions(files, tmp_path, capsys):
    record = files / "comma.csv"  # as spreadsheets of half of Europe write it
    asked = ((1, "compare"), (0, "check"), (1, "improve", "--candidates", "stiffness@link1"))
    for number, (end, *words) in enumerate(asked):
        picture = tmp_path / f"{number}.png"
        more = [*words[1:], "--decimal", ",", "--picture", picture]
        code, out = run(capsys, words[0], files / "model.toml", record, *more)
        assert code == end
        assert str(picture) in out
        assert picture.read_bytes().startswith(SIGNATURES[".png"])


def test_picture_of_a_survey(files, tmp_path, capsys):
    fleet, picture = tmp_path / "fleet", tmp_path / "fleet.svg"
    fleet.mkdir()
    for name in ("a", "b"):
        (fleet / f"{name}.csv").write_bytes((files / "comma.csv").read_bytes())
    words = ("survey", fleet, "--model", files / "model.toml", "--task", "refine", "--decimal", ",")
    words += ("--candidates", "stiffness@link1", "--picture")
    code, out = run(capsys, *words, picture)
    assert code == 0
    assert str(picture) in out
    assert picture.read_bytes().startswith(SIGNATURES[".svg"])
    assert main([*map(str, words), str(tmp_path / "absent" / "fleet.png")]) == 2
    assert "make it first" in capsys.readouterr().err


def test_a_decimal_mark_is_for_text(files, capsys, tmp_path):
    np.savez(tmp_path / "record.npz", time=np.arange(5.0))
    assert main(["compare", str(files / "model.toml"), str(tmp_path / "record.npz"), "--decimal", ","]) == 2
    assert "decimal mark" in capsys.readouterr().err
