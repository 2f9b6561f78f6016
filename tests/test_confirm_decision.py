"""When further records refute a model: estimates and tests of each record in, the word out.

A record is what the model fitted to it alone gives: coefficients with standard deviations, p-values of the
tests of its residual, and the error of the model as a share of the motion. Innovations are `NOISE` of the
spread of the output, in `SAMPLES` samples: coefficients that are `z` deviates wrong change ``NOISE z /
sqrt(SAMPLES)`` of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import control as ct
import numpy as np
import pytest
from scipy.stats import chi2, norm

import rcorefine as rco
from rcorefine.diagnosis import confirm as room
from rcorefine.inference.f_tests import FTest

LEVEL, MATTERS = 0.005, 0.01
NOISE, SAMPLES = 0.2, 400  # a deviate changes a hundredth of the motion


class Fitted(NamedTuple):
    """What one record says when the model is fitted to it alone."""

    theta: Sequence[float] = (1.0,)
    sd: Sequence[float] = (1.0,)
    p: Sequence[float] = (0.5,)
    error: float = 1.0  # the model's, as a share of the motion
    factor: Sequence[float] = (1.0,)  # of the condition, to that of the first record
    amplitude: float = 2.0
    noise: float = NOISE


def confirmed(
    first: Fitted,
    *further: Fitted,
    what: str = "law at link1",
    level: float = LEVEL,
    matters: float = MATTERS,
) -> rco.Confirmation:
    """Let the records decide."""
    every = (first, *further)
    records: Any = [SimpleNamespace(name=f"r{i}") for i in range(len(every))]
    fits: list[Any] = []
    for fit in every:
        outputs = np.tile([[1.0, -1.0], [3.0, -3.0]], SAMPLES // 4)
        problem = SimpleNamespace(weights=np.array([1.0, 2.0]), records=[SimpleNamespace(outputs=outputs)])
        tested: Any = SimpleNamespace(
            fitted=SimpleNamespace(problem=problem),
            whitener=SimpleNamespace(scales=np.array([fit.noise, 0.1 * fit.noise])),
            residual=np.zeros((2, SAMPLES // 2)),
            p=[FTest(f"test {i}", 1.0, 1, p, 1.0, 1.0) for i, p in enumerate(fit.p)],
            shares=[SimpleNamespace(model=share * fit.error) for share in (0.1, 1.0) if fit.error],
        )
        fits.append(room._Alone(tested, np.array(fit.theta), np.diag(np.square(fit.sd))))
    sizes = [1.0, *(fit.amplitude for fit in further)]
    factors = np.array([fit.factor for fit in every])
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(room, "_tested", lambda tested, rest: tested.p)
        patched.setattr(room, "error_shares", lambda tested, tests, significance: tested.shares)
        found = room._estimates(records, sizes, fits, factors, [], level)
    verdict, p_value, message = room._concluded(what, found, level, matters)
    return rco.Confirmation(verdict, p_value, (), (), tuple(found), level, message)


def apart(p: float) -> Fitted:
    """A record whose coefficient differs from one by so much; both deviations are one."""
    return Fitted(theta=[1.0 + float(np.sqrt(2) * norm.isf(p / 2))])


SAME, MORE = Fitted(), Fitted(p=[1e-9])
#: Coefficients one and a half deviates off change .015 of the motion, half a deviate .005.
OFF = Fitted(theta=[1.0 + 1e3], sd=[1.0])


@pytest.mark.parametrize(
    ("further", "options", "word"),
    [
        pytest.param([SAME], {}, "confirmed", id="the same law"),
        pytest.param([SAME, SAME, SAME], {}, "confirmed", id="the same law in four records"),
        # agreement
        pytest.param([apart(0.0055)], {}, "confirmed", id="coefficients apart by p = .0055"),
        pytest.param([apart(0.0045)], {}, "refuted", id="coefficients apart by p = .0045"),
        pytest.param([apart(0.0045)], {"level": 0.001}, "confirmed", id="p = .0045 at level .001"),
        pytest.param([apart(0.03)], {"level": 0.05}, "refuted", id="p = .03 at level .05"),
        pytest.param([SAME, apart(0.0045)], {}, "confirmed", id="p = .0045 in one of two: level .0025"),
        pytest.param([SAME, apart(0.0024)], {}, "refuted", id="p = .0024 in one of two"),
        pytest.param([apart(0.0024), SAME], {}, "refuted", id="p = .0024 in the other one"),
        pytest.param(
            [SAME] * 4 + [apart(0.0011)], {}, "confirmed", id="p = .0011 in one of five: level .001"
        ),
        pytest.param([SAME] * 4 + [apart(0.0009)], {}, "refuted", id="p = .0009 in one of five"),
        pytest.param([Fitted(theta=[-9.0])], {}, "refuted", id="the other sign"),
        # residual
        pytest.param([Fitted(p=[0.0055])], {}, "confirmed", id="one test of p = .0055"),
        pytest.param([Fitted(p=[0.0045])], {}, "refuted", id="one test of p = .0045"),
        pytest.param([Fitted(p=[0.0045, 0.5])], {}, "confirmed", id="one of two tests: .009"),
        pytest.param([Fitted(p=[0.0024, 0.5])], {}, "refuted", id="one of two tests: .0048"),
        pytest.param(
            [SAME, Fitted(p=[0.0024, 0.5])], {}, "confirmed", id="one of two tests in one of two records"
        ),
        # what a test finds must matter
        pytest.param([Fitted(p=[1e-9], error=0.011)], {}, "refuted", id="an error of 1.1 %"),
        pytest.param([Fitted(p=[1e-9], error=0.009)], {}, "confirmed", id="an error of .9 %"),
        pytest.param([Fitted(p=[1e-9], error=0.011)], {"matters": 0.02}, "confirmed", id="2 % matter"),
        pytest.param([Fitted(p=[1e-9], error=0.009)], {"matters": 0.0}, "refuted", id="everything matters"),
        pytest.param(
            [Fitted(theta=[11.0], noise=0.019)], {}, "confirmed", id="coefficients that change .95 %"
        ),
        pytest.param(
            [Fitted(theta=[11.0], noise=0.021)], {}, "refuted", id="coefficients that change 1.05 %"
        ),
        pytest.param(
            [Fitted(theta=[11.0], p=[0.5], error=1.0, noise=0.019)],
            {},
            "confirmed",
            id="a large error that no test finds, coefficients that change little",
        ),
        pytest.param(
            [Fitted(theta=[1.5], p=[1e-9], error=0.001)],
            {},
            "confirmed",
            id="coefficients that agree, a test that finds little",
        ),
        pytest.param(
            [Fitted(p=[1e-9], error=0.001), Fitted(p=[0.5], error=1.0)],
            {},
            "confirmed",
            id="found in one record, large in the other",
        ),
        pytest.param(
            [Fitted(p=[1e-9], error=0.0)], {}, "refuted", id="a response, which has no motion to share"
        ),
        # the first record
        pytest.param(
            [SAME], {"first": Fitted(p=[1e-9])}, "confirmed", id="the first residual decides nothing"
        ),
        pytest.param(
            [SAME], {"first": Fitted(sd=[30.0], theta=[21.0])}, "confirmed", id="the first is unsure"
        ),
        pytest.param([Fitted(sd=[30.0], theta=[21.0])], {}, "confirmed", id="the second is unsure"),
        # conditions
        pytest.param(
            [Fitted(theta=[20.0], factor=[2.0])], {"first": Fitted(theta=[10.0])}, "confirmed", id="twice"
        ),
        pytest.param(
            [Fitted(theta=[10.0], factor=[2.0])], {"first": Fitted(theta=[10.0])}, "refuted", id="not twice"
        ),
        pytest.param(
            [Fitted(theta=[10.0], factor=[2.0])],
            {"first": Fitted(theta=[10.0], sd=[2.0])},
            "confirmed",
            id="10 of sqrt(1 + 4 4) = 4.12: 2.4 deviates",
        ),
        # several coefficients
        pytest.param(
            [Fitted(theta=[1, 4.5], sd=[1, 1], factor=[1, 1])],
            {"first": Fitted([1, 1], [1, 1], factor=[1, 1])},
            "confirmed",
            id="3.5 over 1.41 in one of two: p = .047",
        ),
        pytest.param(
            [Fitted(theta=[1, 6.0], sd=[1, 1], factor=[1, 1])],
            {"first": Fitted([1, 1], [1, 1], factor=[1, 1])},
            "refuted",
            id="5 over 1.41 in one of two: p = .0019",
        ),
        pytest.param(
            [Fitted(theta=[1, 6.0], sd=[1, np.inf], factor=[1, 1])],
            {"first": Fitted([1, 1], [1, 1], factor=[1, 1])},
            "confirmed",
            id="a coefficient that a record does not tell",
        ),
        # no effect at all
        pytest.param(
            [Fitted((), (), factor=())], {"first": Fitted((), (), factor=())}, "confirmed", id="no effect"
        ),
        pytest.param(
            [Fitted((), (), p=[1e-9], factor=())],
            {"first": Fitted((), (), factor=())},
            "refuted",
            id="no effect, and something is missing",
        ),
    ],
)
def test_the_word(further: list[Fitted], options: dict[str, Any], word: str) -> None:
    first = options.get("first", SAME)
    others = {key: value for key, value in options.items() if key != "first"}
    assert confirmed(first, *further, **others).verdict == word


@pytest.mark.parametrize("records", [1, 2, 5])
def test_the_p_value_is_the_smallest_times_the_number_of_further_records(records: int) -> None:
    others = [SAME] * (records - 1)
    assert confirmed(SAME, apart(0.004), *others).p_value == pytest.approx(
        min(1.0, 0.004 * records), rel=1e-6
    )
    assert confirmed(SAME, Fitted(p=[0.002, 0.5]), *others).p_value == pytest.approx(
        0.004 * records, rel=1e-6
    )
    assert confirmed(SAME, *[Fitted(p=[0.6])] * records).p_value == pytest.approx(1.0 if records > 1 else 0.6)


def test_the_difference_is_tested_with_both_covariances_and_the_square_of_the_factor() -> None:
    found = confirmed(Fitted([3.0], [0.5]), Fitted([8.0], [0.7], factor=[2.0])).estimates[1]
    assert found.agreement == pytest.approx(chi2.sf(2.0**2 / (0.7**2 + 4 * 0.5**2), 1))
    assert found.change == pytest.approx(NOISE * 2.0 / 0.7 / np.sqrt(SAMPLES))
    assert confirmed(Fitted([3.0]), SAME).estimates[0].agreement == 1.0


@pytest.mark.parametrize(
    ("first", "further", "options", "says", "not_says"),
    [
        (SAME, [SAME], {}, ["explains every record (p"], ["similar", "less than what matters"]),
        (SAME, [Fitted(amplitude=1.2)], {}, ["amplitudes are similar"], []),  # e^.25 = 1.28
        (SAME, [Fitted(amplitude=1.35)], {}, [], ["amplitudes are similar"]),
        (SAME, [Fitted(amplitude=0.75)], {}, [], ["amplitudes are similar"]),
        (SAME, [Fitted(amplitude=0.85)], {}, ["amplitudes are similar"], []),
        (SAME, [Fitted(amplitude=1.0), SAME], {}, [], ["amplitudes are similar"]),
        (SAME, [Fitted(p=[1e-9], error=0.004)], {}, ["to 0.4 % of the motion", "what matters (1 %)"], []),
        (SAME, [OFF], {}, ["r1 needs other coefficients", "only mimics"], ["something more", "first record"]),
        (SAME, [MORE], {}, ["r1 needs something more", "100 % of the motion"], ["other coefficients"]),
        (SAME, [SAME, MORE], {}, ["r2 needs something more"], ["r1"]),
        (SAME, [Fitted(p=[1e-6]), MORE], {}, ["r2 needs something more"], ["r1"]),
        (SAME, [MORE, Fitted(p=[1e-6])], {}, ["r1 needs something more"], ["r2"]),
        (SAME, [Fitted(theta=[1e3], p=[1e-6])], {}, ["other coefficients"], ["something more"]),
        (SAME, [Fitted(theta=[6.0], p=[1e-6])], {}, ["something more"], ["other coefficients"]),
        (Fitted(p=[0.004]), [MORE], {}, ["does not explain the first record either"], ["mimics"]),
        (Fitted(p=[0.006]), [MORE], {}, ["mimics"], ["first record either"]),
        (SAME, [MORE], {"what": ""}, ["The model without an added effect is refuted"], ["mimics"]),
        (SAME, [SAME], {"what": ""}, ["The same model without an added effect"], []),
    ],
)
def test_what_is_said(
    first: Fitted, further: list[Fitted], options: dict[str, Any], says: list[str], not_says: list[str]
) -> None:
    message = confirmed(first, *further, **options).message
    assert [word for word in says if word not in message] == [], message
    assert [word for word in not_says if word in message] == [], message


def conditions(given: dict[str, Any], records: int = 2) -> Any:
    """Factors of a friction and of its speed, which shapes it, under conditions."""
    friction = SimpleNamespace(kind="friction", place="shaft", spec=SimpleNamespace(shaping=("speed",)))
    rows = [SimpleNamespace(effect=0, name="level"), SimpleNamespace(effect=0, name="speed")]
    structure = SimpleNamespace(parameters=rows, effects=[friction])
    model: Any = SimpleNamespace(simulation_structure=lambda: (structure,))
    data = [
        rco.Measurement(np.full(9, 2.0 * i + 1), np.arange(9.0), dt=0.1, input_labels="load")
        for i in range(records)
    ]
    return room._conditions(model, [0, 1], data, given)[1].tolist()


@pytest.mark.parametrize(
    ("given", "factors"),
    [
        ({}, [[1, 1], [1, 1]]),
        ({"friction@shaft": [2.0, 6.0]}, [[1, 1], [3, 1]]),
        ({"friction@shaft": [-2.0, -6.0]}, [[1, 1], [3, 1]]),
        ({"friction@shaft": "load"}, [[1, 1], [3, 1]]),
        ({"friction@shaft": [2.0, -6.0]}, rco.DataError),
        ({"friction@shaft": [2.0, 0.0]}, rco.DataError),
        ({"friction@shaft": [-2.0, 0.0]}, rco.DataError),
        ({"damping@shaft": [2.0, 6.0]}, ct.ControlArgument),
        ({"friction@shaft": "torque"}, ct.ControlArgument),
    ],
)
def test_a_condition_scales_what_does_not_shape_the_law(given: dict[str, Any], factors: Any) -> None:
    if isinstance(factors, list):
        assert conditions(given) == factors
        return
    with pytest.raises(factors, match="scales_with"):
        conditions(given)
