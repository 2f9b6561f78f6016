"""What may be a step of a ladder, what goes again, and what is said at its end."""

from __future__ import annotations

import functools
from dataclasses import replace
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from cases import slow
from hidden.generator import Law, held_motion
from inner import Hypothesis, Structure, levels
from scipy.signal import cont2discrete, dlsim

import rcorefine as rco
from rcorefine.diagnosis.hypothesis import Trial
from rcorefine.diagnosis.verdict import undetermined
from rcorefine.results import with_error

DT = 0.02


def mass() -> rco.PhysicalModel:
    return rco.mass_spring_damper([1.0], [0.6], [80.0], sensors="velocity")


def oscillator(
    seed: int, n: int, *, spring: float = 80.0, friction: float = 0.0, until: int = 0
) -> rco.Measurement:
    """One mass, integrated; with dry friction up to a sample."""
    rng = np.random.default_rng(seed)
    force = 5 * rng.standard_normal(n)
    A, steer = [[0.0, 1.0], [-spring, -0.6]], np.outer(force, [0.0, 1.0])
    brake = (Law("coulomb_friction", np.array([friction, 1e-3, 0.0])), [0, -1], [1, 0], [0, 1])
    braked = held_motion(A, steer[: until + 1], DT, [brake])
    seen = np.concatenate([braked[:-1], held_motion(A, steer[until:], DT, start=braked[-1])])[:, 1]
    return rco.Measurement(force, seen + 0.02 * seen.std() * rng.standard_normal(n), dt=DT)


def tanks(seed: int, n: int, noise: float = 0.05) -> tuple[ct.StateSpace, rco.Measurement]:
    """Two tanks with square-root outflow, an overflow, a capped sensor; and a poor linear guess."""
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.3, 5.0, -(-n // 12)), 12)[:n]
    h1 = h2 = 2.0
    seen = np.empty(n)
    for k in range(n):
        seen[k] = min(h2, 9.0)
        for _ in range(8):
            out1, out2, over = 0.12 * np.sqrt(h1), 0.10 * np.sqrt(h2), 0.25 * max(h1 - 5.0, 0.0)
            h1, h2 = h1 + 0.5 * (0.088 * pump[k] - out1 - over), h2 + 0.5 * (out1 + 0.6 * over - out2)
    model = ct.ss(
        [[-0.03, 0], [0.03, -0.03]], [[0.08], [0]], [[0, 1]], 0,
        inputs="pump", outputs="level2", states=["level1", "level2"], name="tanks",
    )  # fmt: skip
    data = rco.Measurement(
        pump, seen + noise * rng.standard_normal(n), dt=4.0, input_labels="pump", output_labels="level2"
    )
    return model, data


def judged(step) -> float:
    return float(np.mean(np.log(step.validation_rmse)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6, 10])
def test_a_ladder_never_ends_worse_than_it_began_on_what_judges(seed: int) -> None:
    """The last fifth has levels that the rest does not: what was learned there may not hold here."""
    model, data = tanks(seed, 400)
    kinds = [
        "sqrt_flow",
        "quadratic_damping",
        "threshold_flow",
        "output_delay",
        "input_lag",
        "output_saturation",
    ]
    laws = [e for e in rco.effect_library(model) if e.kind in kinds]
    ladder = rco.improve(model, data, free="linear", candidates=laws)
    assert judged(ladder.steps[-1]) <= judged(ladder.steps[0])
    assert all(np.isfinite(row.std) for row in ladder.refinement.parameters if row.role == "effect")
    assert ("max_effects" in ladder.message) == (len(ladder.effects) == 4 and ladder.verdict != "adequate")
    assert ("No residual test" in ladder.message) == (ladder.verdict == "adequate")


def test_a_tied_effect_that_the_choosing_part_contradicts_is_not_taken() -> None:
    """Friction that is there in the first 60 % and gone after them: the likelihood alone is sure."""
    data = oscillator(3, 1000, friction=0.9, until=600)
    laws = [rco.Effect(kind, "link1") for kind in ("coulomb_friction", "asymmetric_friction")]
    first = rco.diagnose(mass(), data.split(0.6)[0], candidates=laws)
    assert first.verdict == "effect"  # what merely contains it is no rival
    ladder = rco.improve(mass(), data, candidates=laws)
    assert ladder.effects == ()
    assert ladder.verdict != "adequate"
    # refused by the part that chooses, or taken back by the one that judges
    assert "No other set" in ladder.message or "Removed" in ladder.message
    assert ladder.refinement.rmse == pytest.approx(ladder.steps[0].train_rmse)


@pytest.fixture(scope="module")
def data() -> rco.Measurement:
    return oscillator(8, 800, spring=75.0)


KINDS = ("stiffness", "damping", "cubic_stiffness", "quadratic_damping", "cubic_damping", "coulomb_friction")


@pytest.mark.parametrize(("spring", "held"), [(80.0, []), (75.0, ["stiffness"])])
def test_what_the_record_does_not_determine_does_not_stay(spring: float, held: list[str]) -> None:
    """Where the spring is not off it goes, too; a cap of the sensor is never reached."""
    record = oscillator(8, 800, spring=spring)
    laws = [rco.Effect(kind, "link1") for kind in KINDS]
    laws.append(rco.Effect("output_saturation", mass().linear.output_labels[0]))
    ladder = rco.improve(mass(), record, candidates=laws)
    assert [effect.kind for effect in ladder.effects] == held
    assert [step.action for step in ladder.steps] == ["start", *("add" for _ in held)]
    assert ladder.verdict == "adequate"


@pytest.mark.parametrize("most", [0, *slow(1)])
def test_a_ladder_has_no_more_steps_than_asked_for(data: rco.Measurement, most: int) -> None:
    """The spring is the truth, the rest noise."""
    laws = [rco.Effect(kind, "link1") for kind in KINDS]
    ladder = rco.improve(mass(), data, candidates=laws, max_effects=most)
    assert [effect.kind for effect in ladder.effects] == ["stiffness"][:most]
    assert [step.action for step in ladder.steps] == ["start", "add"][: 1 + most]
    assert ("max_effects = 0" in ladder.message) == (most == 0)


def test_what_the_first_part_cannot_show_is_sought_on_all_that_does_not_judge() -> None:
    """Two rooms whose second one loses heat that the model lacks, over three of its time constants."""
    near, out, loss, heat = 60.0, 20.0, 8.0, np.array([3e5, 2e6])  # W/K, J/K

    def rooms(lost: float) -> list[np.ndarray]:
        flows = np.array([[-near - out, near], [near, -near - lost]])
        return [flows / heat[:, None], np.array([[1.0], [0.0]]) / heat[:, None], np.eye(2), np.zeros((2, 1))]

    rng = np.random.default_rng(1)
    power = 600 * np.repeat(rng.standard_normal(30), 60)
    _, warm, _ = dlsim(cont2discrete(rooms(loss), 60.0), power)
    seen = warm.T + 0.01 * warm.T.std(axis=1, keepdims=True) * rng.standard_normal((2, 1800))
    model = ct.ss(*rooms(0.0), states=["T1", "T2"], inputs="P", outputs=["T1", "T2"])
    data = rco.Measurement(power, seen, dt=60.0, input_labels="P", output_labels=["T1", "T2"])
    found = rco.improve(model, data, candidates=[rco.Effect("damping", "T1"), rco.Effect("damping", "T2")])
    assert [(e.kind, e.place) for e in found.effects] == [("damping", "T2")]
    assert np.allclose(found.steps[-1].validation_rmse, 0.01 * warm.std(axis=0), rtol=0.15)


@pytest.mark.parametrize(
    ("kind", "figures", "named"),
    [
        ("power_damping", {"damping": (2.0, 0.5), "power": (1.5, 0.2)}, True),
        ("power_damping", {"damping": (2.0, 0.7), "power": (1.5, 0.2)}, False),  # size
        ("power_damping", {"damping": (2.0, 0.5), "power": (0.3, 1.4)}, False),  # shape
        ("power_damping", {"damping": (2.0, 0.5), "power": (1.5, np.inf)}, False),
        ("power_damping", {"damping": (-2.0, 0.1), "power": (1.5, 0.2)}, False),  # it would drive
        ("coulomb_friction", {"force": (-2.0, 0.1)}, False),
        ("cubic_stiffness", {"cubic_stiffness": (-2.0, 0.1)}, True),  # a softening spring
        ("damping", {"damping": (-0.2, 0.01)}, True),  # less than the model has
        ("asymmetric_friction", {"force_plus": (3.0, 0.1), "force_minus": (-1.0, 0.1)}, True),  # and a push
        ("asymmetric_friction", {"force_plus": (1.0, 0.1), "force_minus": (-3.0, 0.1)}, False),
        ("end_stop", {"stiffness": (9.0, 1.0), "position": (0.01, 0.02)}, True),  # zero is a place as any
        ("cogging", {"sine": (0.1, 0.1), "cosine": (3.0, 0.1), "period": (1.0, 0.1)}, True),  # one is enough
    ],
)  # fmt: skip
def test_one_rule_says_what_is_determined(
    data: rco.Measurement, kind: str, figures: dict[str, tuple[float, float]], named: bool
) -> None:
    """A size 3 standard deviations from zero, each positive shape too, and no friction that drives."""
    law = rco.Effect(kind, "link1")
    plain = rco.refine(mass(), data, [rco.Effect("stiffness", "link1")]).parameters[0]
    rows = [
        replace(plain, name=name, kind=kind, coefficient=float(value), std=std)
        for name, (value, std) in figures.items()
    ]
    assert tuple(figures) == law.coefficients
    model = replace(rco.refine(mass(), data, offset=False), parameters=tuple(rows))
    assert bool(undetermined(model, law, levels())) != named
    values, std = np.array(list(figures.values()), dtype=float).T
    problem = SimpleNamespace(structure=Structure(mass(), [law]), unpack=lambda _: (values, None))
    base, run = SimpleNamespace(problem=SimpleNamespace(n_theta=0)), SimpleNamespace(point=None)
    trial = Trial(Hypothesis((law,)), base, problem, run)
    trial.sd = std
    assert trial.determined(levels().moved) == named


def test_a_fixed_shape_need_not_be_determined(data: rco.Measurement) -> None:
    law = rco.Effect("power_damping", "link1", fixed={"power": 1.5})
    found = rco.refine(mass(), data, [law])
    row = found.parameter("power_damping")
    assert bool(undetermined(found, law, levels())) == (not row.coefficient > 3 * row.std)


def test_friction_that_drives_is_no_name() -> None:
    """A force along the motion: friction with the wrong sign explains it, and nothing that physics has."""
    rng = np.random.default_rng(3)
    push = 10 * rng.standard_normal(800)
    drive = (Law("coulomb_friction", np.array([-1.0, 1e-3, 0.0])), [-1.0], [0.0], [1.0])
    speed = held_motion([[-2.0]], push[:, None], 0.05, [drive])[:, 0]
    data = rco.Measurement(push, speed + 0.01 * speed.std() * rng.standard_normal(800), dt=0.05, hold="zoh")
    model, friction = rco.dc_motor(gain=0.5, time_constant=0.5), rco.Effect("coulomb_friction", "shaft")
    ladder = rco.improve(model, data, candidates=[friction])
    assert ladder.diagnosis is not None
    assert ladder.diagnosis.verdict == "unexplained"
    assert any("its value must be positive" in note for note in ladder.diagnosis.notes)
    assert friction not in ladder.effects  # a table, if anything


def cart(seed: int, n: int, drag: float = 0.25) -> rco.Measurement:
    """Position of one mass with a drag, pushed in steps of two seconds; noise of 0.3."""
    rng = np.random.default_rng(seed)
    push = np.repeat(rng.standard_normal(n // 40), 40)
    plant = [[0.0, 1.0], [0.0, -drag]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]]
    _, place, _ = dlsim(cont2discrete([np.array(part) for part in plant], 0.05), push)
    labels = {"input_labels": "force", "output_labels": "position"}
    return rco.Measurement(push, place[:, 0] + 0.3 * rng.standard_normal(n), dt=0.05, hold="zoh", **labels)


def cart_model() -> ct.StateSpace:
    """The drag is off by a fifth, and the gain by as much."""
    names = {"inputs": "force", "outputs": "position", "states": ["place", "speed"]}
    return ct.ss([[0, 1], [0, -0.2]], [[0], [1.0]], [[1, 0]], 0, **names)


@functools.cache
def improved_cart(seed: int) -> tuple[rco.Measurement, rco.Improvement]:
    data = cart(seed, 2000)
    laws = [rco.Effect(kind, "place") for kind in ("cubic_stiffness", "coulomb_friction")]
    return data, rco.improve(cart_model(), data, candidates=laws)


def missed(model: rco.Refinement, record: rco.Measurement, horizon: float) -> float:
    return float(np.sqrt(np.mean(rco.compare(model, record, horizon=horizon).residual ** 2)))


@pytest.mark.parametrize("seed", [1, *slow(2)])
def test_no_result_is_worse_than_a_linear_refit_where_the_model_integrates(seed: int) -> None:
    """The drag is off, and no candidate is: a tenth of each part alone would not show it."""
    data, found = improved_cart(seed)
    learn, judge = data.split(0.8)
    _, choose = learn.split(0.75)
    linear = rco.refine(cart_model(), learn, free="linear", horizon=10.0)
    # both were fitted to this part: a log-likelihood of 4.6 and a half for each parameter may be chance
    chance = (4.6 + 0.5 * len(linear.parameters)) / choose.n_samples
    for part in (choose, judge):
        apart = np.log(missed(found.refinement, part, 10.0) / missed(linear, part, 10.0))
        assert apart < chance
    rows = [row for row in found.refinement.parameters if row.role == "linear"]
    assert rows
    told = " ".join(str(found).split())
    for row in rows:
        assert f"{row.name} at {row.place}" in told
        assert with_error(row.value, row.std, row.unit) in told


def test_all_parts_of_a_record_have_the_horizon_of_the_whole_one() -> None:
    """A tenth of the record, where the model integrates; it is printed."""
    data, found = improved_cart(1)
    learn, judge = data.split(0.8)
    choose = learn.split(0.75)[1]
    first = found.steps[0]
    assert first.choice_rmse[0] == pytest.approx(missed(first.refinement, choose, 10.0), rel=1e-6)
    assert first.validation_rmse[0] == pytest.approx(missed(first.refinement, judge, 10.0), rel=1e-6)
    assert len(first.refinement.initial_states) == len(found.steps[-1].refinement.initial_states) == 8
    assert "windows of 10 s" in " ".join(str(found).split())


def test_a_sensor_that_shows_the_size_of_the_speed_is_found_behind_a_soft_shaft() -> None:
    """All linear parameters float: the fit without the law bends them and the offset far away."""
    from scipy.linalg import expm

    rng = np.random.default_rng(2)
    inertia, stiffness, n, dt = (0.01, 0.02), 4.0, 1500, 0.01
    torque = np.repeat(rng.uniform(-1, 1, n // 15), 15)

    def matrices(off: float) -> tuple[np.ndarray, np.ndarray]:
        k, c, b = stiffness * off, 0.02, 0.03 * off
        A = np.array(
            [
                [0, 1, -1],
                [-k / inertia[0], -(c + b) / inertia[0], c / inertia[0]],
                [k / inertia[1], c / inertia[1], -(c + b) / inertia[1]],
            ]
        )
        return A, np.array([[0], [1 / inertia[0]], [0]])

    A, B = matrices(1.0)
    step = expm(np.block([[A, B], [np.zeros((1, 4))]]) * dt)
    x, seen = np.zeros(3), np.empty(n)
    for i in range(n):
        seen[i] = abs(x[2])
        x = (step @ np.append(x, torque[i]))[:3]
    data = rco.Measurement(
        torque,
        seen + 0.02 * seen.std() * rng.standard_normal(n),
        dt=dt,
        input_labels="torque",
        output_labels="speed",
    )
    model = ct.ss(
        *matrices(1.15), [[0, 0, 1]], 0, inputs="torque", outputs="speed", states=["twist", "w1", "w2"]
    )
    kinds = ("output_rectification", "input_deadzone", "coulomb_friction", "output_saturation")
    laws = [e for e in rco.effect_library(model) if e.kind in kinds]
    ladder = rco.improve(model, data, free="linear", candidates=laws)
    assert [effect.kind for effect in ladder.effects] == ["output_rectification"]
    assert ladder.refinement.parameter("output_rectification").value == pytest.approx(1.0, abs=0.01)
    assert ladder.verdict == "adequate"
    assert ladder.steps[-1].validation_rmse[0] == pytest.approx(0.02 * seen.std(), rel=0.15)
