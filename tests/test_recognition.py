"""A plain model is recognized once: the same content gives the same object, other content another one."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor

import control as ct
import numpy as np
import pytest
from inner import as_physical

import rcorefine as rco


def chain(stiffness: float = 3.0, **labels) -> ct.StateSpace:
    """Two masses on springs, without what a builder knows."""
    plain = rco.mass_spring_damper([1.0, 2.0], [0.1, 0.1], [stiffness, 2.0]).system
    return ct.ss(*ct.ssdata(plain), **{"states": plain.state_labels, "name": "plain", **labels})


def numbers(model: rco.PhysicalModel) -> dict[str, float]:
    return {q.name: q.value for q in model.parameters}


def test_same_content_is_recognized_once():
    system = chain()
    first = as_physical(system)
    assert as_physical(system) is first
    assert as_physical(chain()) is first  # another object of the same content
    assert rco.PhysicalModel.from_statespace(system) is first


@pytest.mark.parametrize("key", "ABCD")
def test_a_changed_matrix_is_recognized_anew(key):
    system = chain()
    first, before = as_physical(system), getattr(as_physical(system).linear, key).copy()
    changed = getattr(system, key).copy()
    changed[-1, 0] += 0.25
    setattr(system, key, changed)
    again = as_physical(system)
    assert again is not first
    np.testing.assert_array_equal(getattr(again.linear, key), changed)
    np.testing.assert_array_equal(getattr(first.linear, key), before)


def test_an_entry_changed_in_place_is_seen():
    system = chain()
    first = numbers(as_physical(system))
    system.A[2, 0] -= 1.0  # a stiffer spring from mass 1 to the ground
    again = numbers(as_physical(system))
    assert again["k[q1]"] == pytest.approx(first["k[q1]"] + 1.0)
    assert again["k[q1-q2]"] == pytest.approx(first["k[q1-q2]"])


def test_names_and_timebase_are_content():
    models = [
        as_physical(chain()),
        as_physical(chain(states=["x1", "x2", "v1", "v2"])),
        as_physical(chain(inputs=["f"])),
        as_physical(chain(outputs=["a", "b"])),
        as_physical(chain(name="other")),
        as_physical(ct.ss(*ct.ssdata(chain()), 1.0)),
        as_physical(ct.ss(*ct.ssdata(chain()), True), dt=0.1),
        as_physical(ct.ss(*ct.ssdata(chain()), True), dt=0.2),
    ]
    assert len({id(model) for model in models}) == len(models)


def test_declarations_are_content():
    system = chain()
    heavy = rco.physical(system, parameters={"m1": ("mass", "q1", 4.0)})
    light = rco.physical(system, parameters={"m1": ("mass", "q1", 2.0)})
    assert heavy.port("q1").act[2] == -0.25
    assert light.port("q1").act[2] == -0.5
    assert as_physical(system).port("q1").act[2] == -1.0


def test_what_is_kept_cannot_be_spoiled():
    model = as_physical(chain())
    arrays = [getattr(model.linear, key) for key in "ABCD"]
    arrays += [model.output_state, model.output_rate, model.output_input]
    arrays += [getattr(port, key) for port in model.ports for key in ("act", "position", "velocity")]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
    model.system.A[...] = 0.0  # built anew at each call
    assert model.linear.A.any()
    assert as_physical(chain()) is model


def test_a_model_of_the_user_stays_writable():
    system = chain()
    as_physical(system)
    system.A[0, 2] = 2.0
    assert system.A[0, 2] == 2.0


def test_threads_get_what_one_thread_gets():
    def found(k: int) -> dict[str, float]:
        return numbers(as_physical(chain(3.0 + k % 20)))  # more models than are kept

    alone = [found(k) for k in range(40)]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(found, range(40))) == alone


def test_a_recognized_model_can_be_pickled():
    model = as_physical(chain())
    again = pickle.loads(pickle.dumps(model))
    assert numbers(again) == numbers(model)
    assert [port.name for port in again.ports] == [port.name for port in model.ports]
    np.testing.assert_array_equal(again.linear.A, model.linear.A)


def test_a_doubtful_conversion_warns_every_time():
    system = ct.ss([[-0.9, 0.1], [-0.1, -0.9]], [[1.0], [0.0]], [[1.0, 0.0]], 0, 0.1)
    for _ in range(2):
        with pytest.warns(rco.ConversionWarning, match="Nyquist"):
            as_physical(system)
