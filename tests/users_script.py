"""A user's script with every public name, for mypy --strict (pyproject.toml) to read; nobody runs it."""

from __future__ import annotations

import warnings
from pathlib import Path

import control as ct
import numpy as np

import rcorefine as rco


def plants() -> list[rco.PhysicalModel]:
    """A model of each builder."""
    return [
        rco.mass_spring_damper([1.0, 1.0], [0.5, 0.5], [100.0, 80.0]),
        rco.mechanical(np.eye(2), K=[[2.0, -1.0], [-1.0, 1.0]]),
        rco.series_rlc(100.0, 1e-3, 1e-6),
        rco.dc_motor(J=0.01, b=0.1, Kt=0.01, R=1.0, L=0.5),
        rco.quarter_car(250.0, 35.0, 16e3, 1e3, 160e3),
        rco.two_tanks(),
        rco.thermal_network([1.0], {(0, 1): 0.5}),
        rco.physical(ct.ss([[0, 1], [-4, -1]], [[0], [1]], [[1, 0]], 0), units={"u[0]": "N"}),
    ]


def from_files(folder: Path) -> rco.Simulation:
    """A model and a record out of files, and the record of a plant that rubs."""
    model = rco.read_model(folder / "model.toml")
    data: rco.Measurement = rco.read_record(folder / "record.csv", model, time="t")
    friction = rco.Effect("coulomb_friction", "link1", fixed={"force": 0.5})
    return rco.simulate(model, data, "zero", effects=[friction])


def tested(path: Path) -> ct.StateSpace:
    """Modes of a hammer test."""
    return rco.modal_model(path, "7:3", sensors="acceleration")


def door(model: rco.PhysicalModel, data: rco.Measurement) -> list[str]:
    """What is odd, and where effects could act."""
    looked: rco.Check = rco.check(model, data)
    rows: tuple[rco.CheckRow, ...] = looked.looks
    places: list[rco.Port] = list(rco.ports(model))
    numbers: list[rco.NominalParameter] = list(model.parameters)
    table = rco.Table([-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0])
    print(rco.describe_effects(rco.effect_library(model)), table)
    return [row.sentence for row in rows] + [port.name for port in places] + [item.name for item in numbers]


def loop(model: rco.PhysicalModel, data: rco.Measurement, page: Path) -> rco.Refinement:
    """Compare, diagnose, refine, confirm, improve."""
    before: rco.Comparison = rco.compare([model, rco.black_box(data)], data)
    servo: rco.Comparison = rco.compare(model, data, controller=rco.Controller(4.0, 0.05, (-1.0, 1.0)))
    found: rco.Diagnosis = rco.diagnose(model, data)
    better: rco.Refinement = rco.refine(model, data, [rco.Effect("coulomb_friction", "link1")])
    row: rco.EstimatedParameter = better.parameters[0]
    again: rco.Confirmation = rco.confirm(better, [data])
    ladder: rco.Improvement = rco.improve(model, data)
    run: rco.Simulation = rco.simulate(better, data)
    levels: rco.AmplitudeResponse = rco.frequency_response_at(better, [1.0, 2.0], [0.5])
    damage: rco.DamageMap = rco.localize_damage(model, data)
    fleet: rco.Survey = rco.survey(model, {"a": [data]})
    response: rco.FrequencyResponse = data.frequency_response()
    found.report(page)
    print(
        before.fit,
        servo.fit,
        row.value,
        again,
        ladder.verdict,
        run.outputs,
        levels,
        damage.named,
        fleet.rows,
        response,
    )
    rco.explore(model, data).show()
    return better


def stream(model: ct.StateSpace, data: rco.Measurement) -> ct.StateSpace:
    """Sample by sample, with an alarm; back to continuous time."""
    refiner = rco.RCORefiner(model, dt=data.dt)
    monitor = rco.Monitor(model, [rco.Effect("stiffness", "link1")], dt=data.dt)
    try:
        with warnings.catch_warnings():
            kinds = (rco.ConversionWarning, rco.ExcitationWarning, rco.IdentifiabilityWarning, rco.RCOWarning)
            for kind in kinds:
                warnings.simplefilter("error", kind)
            refiner.update(data.inputs, data.outputs)
            monitor.update(data.inputs, data.outputs)
    except (rco.DataError, rco.DivergenceError, rco.ModelError, rco.MissingExtraError) as error:
        raise rco.RCOError("the record cannot be used") from error
    alarm: rco.Alarm | None = monitor.alarm
    print(alarm, rco.examples.rlc(), rco.exercises.hidden_effect(1))
    return rco.d2c(refiner.system)
