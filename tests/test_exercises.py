"""Exercises of a course: what is hidden can be found, right told from wrong, and nothing shows the truth."""

from __future__ import annotations

import csv
import dataclasses
import json
import pickle

import control as ct
import numpy as np
import pytest
from cases import slow

import rcorefine as rco
from rcorefine import exercises
from rcorefine.exercises.hiding import LEVELS


def found_in(exercise):
    found = rco.diagnose(exercise.model, exercise.train, candidates=exercise.candidates)
    return found, found.best.effect, next(iter(found.best.coefficients.values()))


def right_of(exercise):
    """What is hidden, by trying all candidates."""
    return next(c for c in exercise.candidates if exercise.check(c.kind, c.place).effect == "right")


@pytest.mark.parametrize("plant", [*exercises.plants[:2], *slow(*exercises.plants[2:])])
def test_a_student_finds_it_and_everything_else_is_wrong(plant):
    level = 2
    exercise = exercises.hidden_effect(7, plant, level)
    found, effect, value = found_in(exercise)
    mark = exercise.check(effect.kind, effect.place, value)
    assert mark.effect in ("right", "tied")
    assert mark.coefficient
    assert mark.points == 1.0
    assert exercise.check(effect.kind, effect.place, 1.5 * value).coefficient is False
    assert exercise.check(effect.kind, effect.place, -value).coefficient is False
    for other in exercise.candidates:
        if other not in found.ambiguous:
            wrong = exercise.check(other.kind, other.place)
            assert wrong.effect == ("place" if other.place == effect.place else "wrong")
            assert wrong.coefficient is None
    # with the right effect the free run of the rest is off by the noise alone
    refined = rco.refine(exercise.model, exercise.train, [effect])
    whole = np.hstack([exercise.train.outputs, exercise.test.outputs])
    noise = LEVELS[level][1] * whole.std(axis=1)
    assert rco.compare(refined, exercise.test).rmse == pytest.approx(noise, rel=0.15)


def test_nothing_shows_the_truth():
    """But for the records and the seals, two exercises of one plant are the same to the byte."""
    one, other = (exercises.hidden_effect(seed, "motor") for seed in (1, 5))
    assert right_of(one) != right_of(other)
    assert len(one._seals) > 10
    assert {field.name for field in dataclasses.fields(one)} == {
        "plant", "level", "model", "train", "test", "candidates", "ident", "_seals",
    }  # fmt: skip
    for shown in ("plant", "level", "model", "candidates"):
        first, second = (pickle.dumps(getattr(exercise, shown)) for exercise in (one, other))
        assert first == second
    for record in (one.train, one.test):
        assert record.name == "record"
        assert record.notes == ()
    value = found_in(one)[2]
    assert np.float64(value).tobytes() not in pickle.dumps(one)
    text = str(one) + repr(one) + one._repr_html_()
    assert not any(seal in text for seal in one._seals)
    assert all(str(one).count(effect.kind) >= 1 for effect in one.candidates)


def test_each_seed_hides_another_one_and_the_same_seed_the_same():
    made = [exercises.hidden_effect(seed, "motor", 3) for seed in range(6)]
    assert len({right_of(exercise).label for exercise in made}) >= 3
    again = exercises.hidden_effect(4, "motor", 3)
    assert again.ident == made[4].ident
    assert again._seals == made[4]._seals
    assert len({exercise.ident for exercise in made}) == 6


@pytest.fixture(scope="module")
def exercise():
    return exercises.hidden_effect(2, "pendulum")


@pytest.fixture(scope="module")
def answer(exercise):
    return found_in(exercise)[1:]


def test_saved_with_and_without_its_answer(exercise, answer, tmp_path):
    effect, value = answer
    whole = exercises.load_exercise(exercise.save(tmp_path / "whole.npz"))
    assert whole.check(effect.kind, effect.place, value).points == 1.0
    assert whole.train.timepts == pytest.approx(exercise.train.timepts)
    assert whole.test.timepts == pytest.approx(exercise.test.timepts)
    open_copy = exercises.load_exercise(exercise.save(tmp_path / "copy.npz", answer=False))
    assert (open_copy.ident, open_copy.has_answer) == (exercise.ident, False)
    with pytest.raises(rco.ModelError, match="hand_in"):
        open_copy.check(effect.kind, effect.place)
    np.savez(tmp_path / "other.npz", inputs=np.zeros(3))
    with pytest.raises(rco.DataError, match="no exercise"):
        exercises.load_exercise(tmp_path / "other.npz")


def test_a_folder_is_graded(exercise, answer, tmp_path):
    effect, value = answer
    kept, handed = tmp_path / "kept", tmp_path / "handed"
    kept.mkdir()
    (handed / "group b").mkdir(parents=True)
    exercise.save(kept / "1.npz")
    copy = exercises.load_exercise(exercise.save(tmp_path / "copy.npz", answer=False))
    copy.hand_in(handed / "ada.json", "Ada <b>", effect.kind, effect.place, value)
    copy.hand_in(handed / "group b" / "bob.json", "=Bob()", effect.kind, effect.place)
    wrong = next(c for c in copy.candidates if c.place != effect.place)
    copy.hand_in(handed / "cyd.json", "Cyd", wrong.kind, wrong.place, 1.0)
    (handed / "dan.json").write_text("no JSON")
    answer = json.loads((handed / "ada.json").read_text())
    (handed / "eve.json").write_text(json.dumps({**answer, "student": "Eve", "exercise": "0" * 16}))
    (handed / "fay.json").write_text(json.dumps({**answer, "student": "Fay", "coefficient": "lots"}))
    found = exercises.grade(handed, kept)
    assert {row.file.split("/")[-1]: row.points for row in found.rows} == {
        "ada.json": 1.0, "bob.json": 0.6, "cyd.json": 0.0, "dan.json": 0.0, "eve.json": 0.0, "fay.json": 0.0,
    }  # fmt: skip
    assert {row.file for row in found.rows if row.remark} == {"dan.json", "eve.json", "fay.json"}
    with (handed / "class.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["student"] for row in rows if row["points"] == "0.6"] == ["'=Bob()"]
    page = (handed / "class.html").read_text()
    assert "Ada &lt;b&gt;" in page
    assert "<b>" not in page
    assert "2 of 3 answers name the effect" in page
    assert exercises.grade(handed, kept).csv() == found.csv()  # twice, over its own page
    # a copy of their own, put beside the answers, proves nothing
    assert all(row.remark for row in exercises.grade(handed).rows)
    with pytest.raises(NotADirectoryError):
        exercises.grade(tmp_path / "none")


def test_wrong_arguments_are_named(exercise):
    with pytest.raises(ct.ControlArgument, match="plant"):
        exercises.hidden_effect(1, "rocket")
    with pytest.raises(ct.ControlArgument, match="level"):
        exercises.hidden_effect(1, "motor", 4)
    with pytest.raises(ct.ControlArgument, match="seed"):
        exercises.hidden_effect(-1)
    with pytest.raises(ct.ControlArgument, match="the candidates are"):
        exercise.check("coulomb_friction", "nowhere")
    with pytest.raises(ct.ControlArgument, match="coefficient"):
        exercise.check(exercise.candidates[0].kind, exercise.candidates[0].place, "much")
