"""Surveys: the same rows wherever they are made, nothing stopped by what fails, truths of a fleet found."""

from __future__ import annotations

import json
import multiprocessing
import os
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor

import control as ct
import numpy as np
import pytest
from inner import main

import rcorefine as rco

DT = 0.02
LAWS = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping")]
MODEL = '[mass_spring_damper]\nm = [1.0]\nc = [2.0]\nk = [100.0]\nsensors = "displacement"\n'
IN_PROCESSES = {"mp_context": multiprocessing.get_context("spawn")}


def plant(k=100.0, c=2.0):
    return rco.mass_spring_damper([1.0], [c], [k], sensors="displacement")


def record(k, seed, n=500, c=2.0, kind=rco.Measurement, start=0.0):
    """A record of a mass on a spring k, by the exact response of python-control; 3 % noise."""
    rng = np.random.default_rng(seed)
    force = 10 * rng.standard_normal(n)
    y = ct.forced_response(plant(k, c).system.sample(DT), inputs=force).outputs
    noisy = y + 0.03 * y.std() * rng.standard_normal(n)
    labels = {"input_labels": "force", "output_labels": "q1", "name": f"run{seed}"}
    return kind(force, noisy, timepts=start + DT * np.arange(n), **labels)


class Deadly(rco.Measurement):
    """A record that ends the process that opens it."""

    def __setstate__(self, state):
        if multiprocessing.parent_process() is not None:
            os._exit(3)
        super().__setstate__(state)


@pytest.fixture(scope="module")
def fleet():
    """Five springs a tenth too soft, one of them much softer; a still record, and one that is not there."""
    softness = [90.0, 89.5, 90.5, 90.2, 70.0]
    found = {f"pump{i}": [record(k, 10 * i + j) for j in range(2)] for i, k in enumerate(softness)}
    still = rco.Measurement(np.ones(300), np.zeros(300), dt=DT)
    return {**found, "still": still, "gone": "/nowhere/run.csv"}


@pytest.fixture(scope="module")
def some(fleet):
    """A part of the fleet, for workers that take seconds to start."""
    return {name: fleet[name] for name in ("pump0", "pump4", "still", "gone")}


@pytest.fixture(scope="module")
def here(fleet):
    return rco.survey(plant(), fleet, options={"candidates": LAWS})


def test_rows_verdicts_and_what_failed(here):
    pumps = [f"pump{i}" for i in range(5) for _ in range(2)]
    assert [row.machine for row in here.rows] == [*pumps, "still", "gone"]
    named = [row for row in here.rows if row.verdict == "effect"]
    assert len(named) == 10  # every pump
    for row in named:
        truth = -30.0 if row.machine == "pump4" else -10.0
        assert (row.effect, row.place, row.unit) == ("stiffness", "link1", "N/m")
        assert abs(row.coefficient - truth) < 4 * row.std + 0.6
        assert row.probability > 0.5
        assert row.seconds > 0
    [gone] = here.of("gone")
    assert gone.verdict is None
    assert "FileNotFoundError" in gone.error
    assert gone in here.failed


def test_what_the_fleet_says(here):
    [effect] = [effect for effect in here.effects if effect.kind == "stiffness"]
    assert effect.sort == "common"
    assert [machine.machine for machine in effect.standing_out] == ["pump4"]
    assert effect.mean == pytest.approx(-10.0, abs=1.0)
    assert not here.growing
    text = here.summary()
    assert "pump4 stands out" in text
    assert "Common: stiffness" in text
    assert "failed" in text
    json.dumps(here.to_dict(), allow_nan=False)
    frame = here.to_dataframe()
    assert len(frame) == len(here.rows)
    assert {"machine", "verdict", "effect", "place", "coefficient", "std", "seconds", "error"} <= set(frame)


def test_the_same_on_processes_and_one_that_dies_is_named(some, here):
    """The pool breaks at the deadly record; its row says so, and the others are those made here."""
    with_deadly = {"first": record(90.0, 99), "deadly": record(90.0, 98, kind=Deadly), **some}
    with ProcessPoolExecutor(2, **IN_PROCESSES) as pool:
        there = rco.survey(plant(), with_deadly, effects="own", options={"candidates": LAWS}, executor=pool)
    [deadly] = there.of("deadly")
    assert "BrokenProcessPool" in deadly.error
    assert there.of("first")[0].error is None
    assert [there.of(name) for name in some] == [here.of(name) for name in some]


def test_the_same_on_dask(some, here):
    """A scheduler and two workers, processes of their own; the client as it stands."""
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    with_deadly = {**some, "deadly": record(90.0, 98, kind=Deadly)}
    settings = {"distributed.scheduler.allowed-failures": 0}
    with (
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        there = rco.survey(plant(), with_deadly, options={"candidates": LAWS}, executor=client)
    assert "KilledWorker" in there.of("deadly")[0].error
    assert [there.of(name) for name in some] == [here.of(name) for name in some]


def test_the_same_on_threads_and_the_settings_travel(some, here):
    with ThreadPoolExecutor(1) as pool:
        there = rco.survey(plant(), some, options={"candidates": LAWS}, executor=pool)
    assert [there.of(name) for name in some] == [here.of(name) for name in some]


def test_a_pool_in_which_nothing_lives(fleet):
    """No worker starts: every row says so, and it ends."""
    two = {"a": record(90.0, 1), "b": record(90.0, 2)}
    with ProcessPoolExecutor(1, **IN_PROCESSES, initializer=os._exit, initargs=(3,)) as pool:
        found = rco.survey(plant(), two, "refine", options={"effects": LAWS[:1]}, executor=pool)
    assert all("BrokenProcessPool" in row.error for row in found.rows)


class Interrupted:
    """An executor on which the user presses Ctrl-C at the fifth task."""

    _max_workers = 2
    count = 0

    def submit(self, function, task):
        self.count += 1
        if self.count == 5:
            raise KeyboardInterrupt
        future = Future()
        future.set_result(function(task))
        return future


def test_an_interruption_keeps_what_was_done():
    records = {f"m{i}": record(90.0, i, 300) for i in range(8)}
    with pytest.raises(KeyboardInterrupt) as stop:
        rco.survey(plant(), records, "refine", options={"effects": LAWS[:1]}, executor=Interrupted())
    assert [row.machine for row in stop.value.survey.rows] == ["m0", "m1", "m2", "m3"]
    assert "4 of 8" in stop.value.survey.summary()


def test_growth_of_known_size():
    """A spring of one of four machines that loses 1 N/m a record."""
    records = {f"m{i}": [record(90.0 - (j if i == 2 else 0), 10 * i + j) for j in range(5)] for i in range(4)}
    found = rco.survey(plant(), records, "refine", options={"effects": LAWS[:1]})
    [trend] = found.growing
    assert (trend.machine, trend.kind) == ("m2", "stiffness")
    assert abs(trend.slope + 1.0) < 4 * trend.std


def test_own_effects_are_compared_where_they_are_named():
    """A machine that lacks nothing has no estimate; asked in common, it has one, and it is near zero."""
    records = {"good": record(100.0, 1), **{f"soft{i}": record(85.0, 2 + i) for i in range(3)}}
    own = rco.survey(plant(), records, effects="own", options={"candidates": LAWS})
    common = rco.survey(plant(), records, options={"candidates": LAWS})
    [effect] = [e for e in own.effects if e.kind == "stiffness"]
    assert "good" not in [machine.machine for machine in effect.machines]
    [effect] = [e for e in common.effects if e.kind == "stiffness"]
    [good] = [machine for machine in effect.machines if machine.machine == "good"]
    assert abs(good.value) < 4 * good.std
    assert [row.verdict for row in own.rows] == [row.verdict for row in common.rows]


@pytest.mark.parametrize("task", ["improve", "localize"])
def test_the_other_tasks(task):
    records = {"a": record(85.0, 1, 900), "b": record(85.0, 2, 900)}
    options = {"candidates": LAWS} if task == "improve" else {}
    found = rco.survey(plant(), records, task, options=options)
    for row in found.rows:
        assert row.error is None
        assert (row.effect, row.place) == ("stiffness", "link1")
        assert abs(row.coefficient + 15.0) < 4 * row.std + 0.6
    [effect] = [e for e in found.effects if e.kind == "stiffness"]
    assert {machine.machine for machine in effect.machines} == {"a", "b"}


# ------------------------------------------------------------------ files, folders, the command
def write(path, data):
    columns = np.column_stack([data.timepts, data.inputs[0], data.outputs[0]])
    np.savetxt(path, columns, delimiter=",", header="time,force,q1", comments="", fmt="%.17g")


@pytest.fixture
def folder(tmp_path):
    """Machines as files and as folders; run10 comes after run2."""
    (tmp_path / "model.toml").write_text(MODEL)
    home = tmp_path / "records"
    for machine in ("crane", "lift"):
        (home / machine).mkdir(parents=True)
        for j in (1, 2, 10):
            write(home / machine / f"run{j}.csv", record(90.0 - j * (machine == "lift"), j, 400))
    for i in range(3):
        write(home / f"pump{i}.csv", record(90.0, 20 + i, 400))
    (home / "notes.md").write_text("not a record")
    return tmp_path


def test_a_folder_is_read_where_it_is_needed(folder):
    options = {"options": {"effects": LAWS[:1]}}
    found = rco.survey(folder / "model.toml", folder / "records", "refine", **options)
    assert [row.record for row in found.of("lift")] == ["run1", "run2", "run10"]
    assert found.machines == ("crane", "lift", "pump0", "pump1", "pump2")
    assert not found.failed
    same = {"lift": [record(90.0 - j, j, 400) for j in (1, 2, 10)]}
    in_memory = rco.survey(plant(), same, "refine", **options)
    assert [row.estimates for row in in_memory.rows] == [row.estimates for row in found.of("lift")]


def test_the_command_with_conditions_and_pages(folder, capsys):
    conditions = folder / "conditions.toml"
    conditions.write_text('[[condition]]\nname = "soft"\neffect = "stiffness"\nbelow = -12.0\n')
    words = ["survey", str(folder / "records"), "--model", str(folder / "model.toml"), "--task", "refine"]
    words += [
        "--candidates",
        "stiffness",
        "--conditions",
        str(conditions),
        "--json",
        "--report",
        str(folder / "out"),
    ]
    assert main(words) == 1
    answer = json.loads(capsys.readouterr().out)
    assert {breach["machine"] for breach in answer["breaches"]} == {"lift"}
    assert len(answer["rows"]) == 9
    index = (folder / "out" / "index.html").read_text()
    for machine in ("crane", "lift", "pump0"):
        assert f'href="machine-{machine}.html"' in index
        assert "index.html" in (folder / "out" / f"machine-{machine}.html").read_text()
    conditions.write_text('[[condition]]\neffect = "stiffness"\nbelow = -50.0\n')
    assert main(words[:-3]) == 0
    conditions.write_text('[[condition]]\neffect = "stifness"\nbelow = -50.0\n')
    assert main(words[:-3]) == 2
    assert "stifness" in capsys.readouterr().err


CONDITIONS = {
    "below_fleet": ({"effect": "stiffness", "below_fleet": 3.0}, {"pump4"}),
    "above_fleet": ({"effect": "stiffness", "above_fleet": 50.0}, set()),
    "above": ({"effect": "stiffness", "above": -20.0}, {"pump0", "pump1", "pump2", "pump3"}),
    "machine": ({"effect": "stiffness", "above": -20.0, "machine": "pump1"}, {"pump1"}),
    "errors": ({"errors": 0}, {"gone", "still"}),  # an output that never moves cannot be asked
    "some errors": ({"errors": 2}, set()),
    "share": ({"verdict": "effect", "share": 0.99}, set()),
    "growth": ({"growth": 0.01}, set()),
}


@pytest.mark.parametrize("name", CONDITIONS)
def test_each_condition(here, name):
    table, machines = CONDITIONS[name]
    assert {breach.machine for breach in here.breaches({"condition": [table]})} == machines


def test_a_condition_that_cannot_be_judged_is_not_kept():
    found = rco.survey(plant(), {"a": record(90.0, 1)}, "refine", options={"effects": LAWS[:1]})
    [breach] = found.breaches({"condition": [{"above_fleet": 3.0}]})
    assert "cannot be judged" in breach.sentence


def test_a_folder_has_the_records_that_are_read(tmp_path):
    """The suffixes that a survey looks for are those that `read_record` takes."""
    from rcorefine.fleet.pieces import _RECORDS

    with pytest.raises(rco.DataError) as refused:
        rco.read_record(tmp_path / "run.tdms", inputs="u", outputs="y")
    assert f"a record is a {', '.join(_RECORDS[:-1])} or {_RECORDS[-1]} file" in str(refused.value)


WRONG = (
    {},
    {"condition": []},
    {"condition": [{"above": 1, "below": 2}]},
    {"condition": [{"above": "x"}]},
    {"condition": [{"at_most": 1.0}]},
    {"condition": [{"above": 1.0, "share": 0.1}]},
)


@pytest.mark.parametrize("wrong", WRONG)
def test_conditions_say_what_is_wrong(here, wrong):
    with pytest.raises(rco.DataError, match="condition"):
        here.breaches(wrong)


def test_what_is_asked_wrongly_is_said_before_any_work():
    one = {"a": record(90.0, 1, 300)}
    with pytest.raises(rco.ModelError, match="no model of 'a'"):
        rco.survey({"b": plant()}, one)
    with pytest.raises(rco.DataError, match="hold no record"):
        rco.survey(plant(), {})
    with pytest.raises(TypeError, match="no 'candidate'"):
        rco.survey(plant(), one, options={"candidate": LAWS})
    with pytest.raises(ct.ControlArgument, match="executor must be"):
        rco.survey(plant(), one, executor=2)
    with pytest.raises(ct.ControlArgument, match="records"):
        rco.survey(plant(), [record(90.0, 1, 300)])
