"""A law knows where zero is; a linear model and its constant offsets do not. Truths by tests/hidden."""

from __future__ import annotations

import numpy as np
import pytest
from cases import named, slow
from hidden.generator import Law, held_motion

import rcorefine as rco
from rcorefine.inference.assembly import offsets_everywhere

DT, J, K, D, GROUND = 0.01, (0.5, 0.8), 300.0, 0.3, 0.05
FRICTION = 0.6


def rotors(
    seed: int, offsets: tuple[float, float], bias: float = 0.0, friction: float = FRICTION
) -> rco.Measurement:
    """Two rotors on a shaft, dry friction on the second one, and a tachometer on each."""
    rng = np.random.default_rng(seed)
    torque = 4.0 * np.repeat(rng.standard_normal(100), 12)
    first = [-K / J[0], K / J[0], -(D + GROUND) / J[0], D / J[0]]
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], first, [K / J[1], -K / J[1], D / J[1], -D / J[1]]])
    law = (
        Law("coulomb_friction", np.array([friction, 1e-3, 0.0])),
        np.array([0, 0, 0, -1 / J[1]]), np.array([0, 1, 0, 0]), np.array([0, 0, 0, 1]),
    )  # fmt: skip
    speeds = held_motion(A, np.outer(torque, [0, 0, 1 / J[0], 0]), DT, [law] if friction else [])[:, 2:].T
    y = speeds + 0.02 * speeds.std(axis=1, keepdims=True) * rng.standard_normal(speeds.shape)
    return rco.Measurement(torque + bias, y + np.reshape(offsets, (2, 1)), dt=DT)


def shaft() -> rco.PhysicalModel:
    return rco.mass_spring_damper(J, [GROUND, D], [0.0, K], sensors="velocity")


RIVALS = ("coulomb_friction", "asymmetric_friction", "quadratic_damping", "damping", "stiffness")


@pytest.mark.parametrize(
    ("offsets", "bias", "kinds"),
    [
        pytest.param((6.0, -2.0), 0.0, None, marks=pytest.mark.slow, id="all"),
        pytest.param((-4.0, 3.0), 0.3, RIVALS, id="few"),
    ],
)
def test_friction_keeps_its_name_where_the_tachometers_stand_off_zero(
    offsets: tuple[float, float], bias: float, kinds: tuple[str, ...] | None
) -> None:
    few = kinds and [effect for effect in rco.effect_library(shaft()) if effect.kind in kinds]
    found = rco.diagnose(shaft(), rotors(1, offsets, bias), candidates=few)
    assert found.place == "mass2"
    named(found, rco.Effect("coulomb_friction", "mass2"), FRICTION, share=0.01)
    row = next(r for r in found.ranking if r.effect.kind == "coulomb_friction")
    by_place = {q.place: q for q in row.refinement.parameters if q.role == "offset"}
    for parameter, true in zip(list(by_place.values())[1:], offsets, strict=True):
        assert abs(parameter.value - true) < 4 * parameter.std


@pytest.mark.parametrize("seed", [2, *slow(3)])
def test_offsets_alone_are_no_missing_law(seed: int) -> None:
    assert rco.diagnose(shaft(), rotors(seed, (6.0, -2.0), 0.3, friction=0.0)).verdict == "adequate"


def test_offsets_have_priors_in_the_size_of_their_signals() -> None:
    data = rotors(4, (6.0, -2.0))
    found = offsets_everywhere(shaft(), [data])
    assert len(found) == 3
    sd = np.array([effect.prior["offset"] for effect in found])
    rms = np.sqrt(np.mean(np.vstack([data.inputs, data.outputs]) ** 2, axis=1))
    assert np.all((sd / rms >= 0.99) & (sd / rms <= 30.0))
