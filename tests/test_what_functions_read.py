"""What the functions of a user read may change between two calls: each answer takes it as it is then."""

import dataclasses
import functools
import os
import types
from pathlib import Path

import control as ct
import numpy as np
import pytest

import rcorefine as rco
from rcorefine.effects.effect import unit_forces

FORMS = {}


def form(make):
    FORMS[make.__name__.strip("_")] = make
    return make


def written(text, **scope):
    """A function of d and v whose variables are those of `scope`."""
    exec(f"def read(d, v):\n    return ({text}) * d", scope)
    return scope["read"], scope


@form
def variable(path):
    read, scope = written("K", K=0.0)
    return read, functools.partial(scope.__setitem__, "K")


@form
def closure(path):
    K = 0.0

    def put(value):
        nonlocal K
        K = value

    return lambda d, v: K * d, put


@form
def default(path):
    def read(d, v, K=0.0):
        return K * d

    return read, lambda value: setattr(read, "__defaults__", (value,))


@form
def nested(path):
    table = {"springs": [{"K": 0.0}]}
    return written("table['springs'][0]['K']", table=table)[0], lambda value: table["springs"][0].update(
        K=value
    )


@form
def array(path):
    table = np.zeros((2, 2))
    return written("row[1]", row=table[1])[0], lambda value: table.__setitem__((1, 1), value)


@form
def bound_argument(path):
    held = np.zeros(1)
    return functools.partial(lambda held, d, v: held[0] * d, held), lambda value: held.__setitem__(0, value)


@form
def inherited(path):
    class Base:
        K = 0.0

    class Spring(Base):
        pass

    return written("Spring.K", Spring=Spring)[0], lambda value: setattr(Base, "K", value)


@form
def property_(path):
    held = [0.0]

    class Spring:
        K = property(lambda self: held[0])

    return written("spring.K", spring=Spring())[0], lambda value: held.__setitem__(0, value)


@form
def method(path):
    class Spring:
        __slots__ = ("K",)

        def force(self, d, v):
            return self.K * d

    spring = Spring()
    spring.K = 0.0
    return spring.force, lambda value: setattr(spring, "K", value)


@form
def own_lambda(path):
    class Spring:
        def __init__(self):
            self.K, self.force = 0.0, lambda d, v: self.K * d

    spring = Spring()
    return spring.force, lambda value: setattr(spring, "K", value)


@form
def unusual_pickle(path):
    class Spring:
        K = 0.0

        def __reduce__(self):
            return (object, ())

    spring = Spring()
    return written("spring.K", spring=spring)[0], lambda value: setattr(spring, "K", value)


@form
def module(path):
    inner = types.ModuleType("inner_of_mine")
    outer = types.ModuleType("outer_of_mine")
    inner.K, outer.inner = 0.0, inner
    return written("outer.inner.K", outer=outer)[0], lambda value: setattr(inner, "K", value)


@form
def replaced_helper(path):
    read, scope = written("helper()", helper=lambda: 0.0)
    return read, lambda value: scope.update(helper=lambda: value)


@form
def replaced_code(path):
    def read(d, v):
        return 0.0 * d

    return read, lambda value: setattr(read, "__code__", written(repr(value))[0].__code__)


@form
def environment(path):
    os.environ["RCOREFINE_TEST_STIFFNESS"] = "0.0"
    read = written("float(os.environ['RCOREFINE_TEST_STIFFNESS'])", os=os)[0]
    return read, lambda value: os.environ.update(RCOREFINE_TEST_STIFFNESS=str(value))


@form
def file(path):
    path.write_text("0.0")
    return written("float(path.read_text())", path=path)[0], lambda value: path.write_text(str(value))


@form
def name_that_is_computed(path):
    read, scope = written("globals()['K']", K=0.0)
    return read, functools.partial(scope.__setitem__, "K")


@form
def table_by_index(path):
    values = np.zeros(2)

    def read(d, v):
        return values[min(int(abs(d)), 1)] * d  # no symbol is an index: numba compiles it

    return read, lambda value: values.__setitem__(slice(None), value)


@pytest.fixture
def made(request, tmp_path):
    yield FORMS[request.param](Path(tmp_path, "stiffness"))
    os.environ.pop("RCOREFINE_TEST_STIFFNESS", None)


every = pytest.mark.parametrize("made", FORMS, indirect=True)


@every
@pytest.mark.filterwarnings("ignore:custom cannot be compiled:rcorefine.RCOWarning")
def test_a_law_takes_what_it_reads_as_it_is(made):
    read, put = made
    one = np.ones(1)
    put(60.0)
    effect = rco.Effect("custom", "link1", law=read)
    for value in (60.0, 90.0, 60.0):
        put(value)
        assert unit_forces(effect, one, one, [{}])[0][0] == pytest.approx(value, rel=1e-12)


DATA = rco.Measurement(np.ones(20), np.zeros(20), dt=0.05, hold="zoh")


def rise(rate):
    """x' = u - rate x from rest, u = 1."""
    return (1.0 - np.exp(-rate * DATA.timepts)) / rate


@every
@pytest.mark.filterwarnings("ignore:the functions of:rcorefine.RCOWarning")
def test_a_nonlinear_system_takes_what_it_reads_as_it_is(made):
    read, put = made
    system = ct.nlsys(lambda t, x, u, p: [u[0] - read(x[0], 0.0)], None, states=1, inputs=1, outputs=1)
    for value in (6.0, 9.0, 6.0):
        put(value)
        found = rco.simulate(system, DATA, "zero").outputs.ravel()
        np.testing.assert_allclose(found, rise(value), rtol=1e-6, atol=1e-9)


def of_array(t, x, u, p):
    return [u[0] - p["rates"][0] * x[0]]


def test_a_changed_system_is_another_model():
    rates = np.array([6.0])
    system = ct.nlsys(of_array, None, params={"rates": rates}, states=1, inputs=1, outputs=1)

    def found():
        return rco.simulate(system, DATA, "zero").outputs.ravel()

    np.testing.assert_allclose(found(), rise(6.0), rtol=1e-6)
    rates[0] = 9.0
    np.testing.assert_allclose(found(), rise(9.0), rtol=1e-6)
    system.updfcn = lambda t, x, u, p: [u[0] - 4.0 * x[0]]
    system.outfcn = lambda t, x, u, p: [2.0 * x[0]]
    np.testing.assert_allclose(found(), 2.0 * rise(4.0), rtol=1e-6)


def test_the_model_of_an_unchanged_system_is_made_once():
    system = ct.nlsys(of_array, None, params={"rates": np.array([6.0])}, states=1, inputs=1, outputs=1)
    model = rco.models.conversion.as_physical(system)
    assert rco.models.conversion.as_physical(system) is model


def test_laws_that_are_equal_now_may_differ_later():
    @dataclasses.dataclass(unsafe_hash=True)
    class Spring:
        K: float

        def __call__(self, d, v):
            return self.K * d

    springs, one = [Spring(60.0), Spring(60.0)], np.ones(1)
    effects = [rco.Effect("custom", "link1", law=spring) for spring in springs]
    springs[1].K = 90.0
    assert [unit_forces(e, one, one, [{}])[0][0] for e in effects] == pytest.approx([60.0, 90.0])
