"""Laws as a user writes them: against scipy, against built-in ones, and in every product."""

import ast
import importlib.util
import os
import pickle
import subprocess
import sys
from pathlib import Path

import control as ct
import numpy as np
import pytest
from cases import slow
from inner import KINDS, NUMBA, Engine, FormulaLaw, Structure
from scipy.signal import lsim

import rcorefine as rco
from rcorefine.effects import Coefficient, InputLaw, OutputLaw, PortLaw, compiled

DOCS = Path(__file__).resolve().parents[1] / "docs" / "laws"


def loaded(name):
    """An example of the documentation, as a module that a name leads to."""
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


@pytest.fixture(autouse=True)
def catalogue():
    """The catalogue as it was: examples enter their laws."""
    from rcorefine.effects import law

    before = dict(law._LAWS)
    yield
    law._LAWS.clear()
    law._LAWS.update(before)
    for name in ("power_drag", "magnet_pull", "actuator_play"):
        sys.modules.pop(name, None)


EXAMPLES = {"power_drag": ("mass1", {}), "magnet_pull": ("x", {"gap": 1.0}), "actuator_play": ("force", {})}


def effect_of(name, **more):
    module = loaded(name)
    place, fixed = EXAMPLES[name]
    law = module.MagnetPull if name == "magnet_pull" else None
    return rco.Effect(name, place, law=law, fixed={**fixed, **more.pop("fixed", {})}, **more)


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_law_is_short_and_agrees_with_scipy(name):
    module = loaded(name)
    (law,) = [n for n in ast.parse((DOCS / f"{name}.py").read_text()).body if isinstance(n, ast.ClassDef)]
    assert law.end_lineno - law.lineno < 30
    data = module.record()
    engine = Engine(Structure(module.MODEL, [effect_of(name)]), data, substeps=16, initial=np.zeros(2))
    run = engine.run(np.array(list(module.TRUE.values())))
    assert np.abs(run.outputs - data.outputs).max() < 2e-4 * data.outputs.std()


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_find_their_coefficients(name):
    found = loaded(name).main()
    for row in [row for row in found.parameters if row.role == "effect"]:
        true = loaded(name).TRUE[next(k for k in loaded(name).TRUE if row.name.endswith(k))]
        assert abs(row.value - true) < 5 * row.std + 0.02 * abs(true), row


#: Where `evaluate` writes the derivatives of the value and of the inner state.
SLOTS = {"d": (1, 6), "v": (2, 17), "d_start": (3, 7), "z_start": (4, 8)}


@pytest.mark.parametrize(
    "name", [n for n, k in KINDS.items() if isinstance(k, FormulaLaw) and k.arguments and not k.needs_law]
)
def test_slopes_are_those_of_the_formula(name):
    law = KINDS[name]
    rng = np.random.default_rng(5)
    for _ in range(20):
        point = dict(zip(law.arguments, rng.uniform(0.3, 1.7, len(law.arguments)), strict=True))
        point |= {key: float(rng.normal()) for key in ("d", "v", "w", "y", "d_start") if key in point}
        point |= {key: 1.0 for key in ("current", "input") if key in point}
        told = {law.signals[key]: value for key, value in point.items() if key in law.signals}
        w = np.array([told.get("w", 0.0)])
        row, out = np.zeros((1, 4)), np.zeros((1, compiled.COUNT + 1))
        row[0, : len(law.row)] = [point[key] for key in law.row]
        signals = [told.get(key, 0.0) for key in SLOTS]
        compiled.evaluate(law.code, *signals, row, 0, told.get("width", 1.0), w, out)

        def values(at, law=law):
            return np.ravel(law.law(**at | ({"w": [at["w"]]} if law.feels_inputs else {})))

        np.testing.assert_allclose(out[0, [0, 5][: law.inner_states + 1]], values(point), 1e-12, 1e-12)
        for key in point.keys() - {"width", "current", "input"}:
            if key in law.row:
                slots = 9 + law.row.index(key), 13 + law.row.index(key)
            elif law.signals[key] in SLOTS:
                slots = SLOTS[law.signals[key]]
            elif law.signals[key] == "w":
                slots = (compiled.COUNT,)
            else:
                continue
            slope = (
                values({**point, key: point[key] + 1e-6}) - values({**point, key: point[key] - 1e-6})
            ) / 2e-6
            np.testing.assert_allclose(out[0, list(slots[: slope.size])], slope, 1e-5, 1e-5)


class Drag(PortLaw):
    """Quadratic drag, written again."""

    formula = "f = c v |v|"
    explanation = "Drag at {place}."
    coefficients = (Coefficient("drag", "force/velocity^2", explanation="drag"),)

    @staticmethod
    def law(v, drag):
        return drag * v * abs(v)


class SensorSlack(OutputLaw):
    """Play in a sensor."""

    formula = "r follows y with play of +- gap"
    explanation = "The sensor {place} has play."
    coefficients = (
        Coefficient("gap", "signal", lower=0.0, default_start=None, explanation="play", shapes=True),
    )

    @staticmethod
    def law(y, z_start, gap):
        r = min(max(z_start, y - gap), y + gap)
        return r, r

    def starts(self, seen):
        return [{"gap": float(q)} for q in np.quantile(np.abs(seen.signal), (0.1, 0.3))]


class Backlash(PortLaw):
    """A joint with play that remembers where it was left."""

    formula = "f = k z"
    explanation = "The joint at {place} has play."
    coefficients = (
        Coefficient("stiffness", "force/position", explanation="stiffness"),
        Coefficient("gap", "position", lower=0.0, default_start=0.02, explanation="play", shapes=True),
    )

    @staticmethod
    def law(d, z_start, stiffness, gap):
        z = min(max(z_start, d - gap), d + gap)
        return stiffness * z, z


def drag(d, v):
    return v * abs(v)


def chain(n=1200, seed=0):
    model = rco.mass_spring_damper([1.0, 1.3], [0.4] * 2, [200.0, 260.0], sensors="velocity")
    w = np.cumsum(np.random.default_rng(seed).standard_normal(n))
    w = 5.0 * (w - np.convolve(w, np.ones(101) / 101, "same"))
    return model, rco.Measurement(w, np.zeros((2, n)), dt=0.02, hold="foh")


@pytest.mark.parametrize(
    ("kind", "place", "law", "theta"),
    [
        ("drag", "link1", Drag, [3.0]),
        ("backlash", "link2", Backlash, [40.0, 0.01]),
        ("sensor_slack", "v1", SensorSlack, [0.04]),
    ],
)
def test_derivatives_of_a_law_with_and_without_memory(kind, place, law, theta):
    model, data = chain()
    engine = Engine(Structure(model, [rco.Effect(kind, place, law=law)]), data, substeps=4)
    run = engine.run(np.array(theta))
    assert np.abs(run.outputs - Engine(Structure(model), data).run(np.zeros(0)).outputs).max() > 0
    for i, value in enumerate(theta):
        step = np.zeros(len(theta))
        step[i] = 1e-6 * value
        up, low = (engine.run(np.array(theta) + s, sensitivity=False).outputs for s in (step, -step))
        slope = (up - low) / (2e-6 * value)
        assert np.abs(run.sensitivity[:, :, i] - slope).max() < 5e-3 * np.abs(slope).max()


@pytest.mark.parametrize("law", [Drag, drag], ids=["class", "function"])
def test_a_users_law_runs_as_a_built_in_one(law):
    model, data = chain(3000 if NUMBA else 300)
    effects = {
        "own": rco.Effect("custom", "link1", law=law),
        "built-in": rco.Effect("quadratic_damping", "link1"),
    }
    engines = {name: Engine(Structure(model, [e]), data, substeps=4) for name, e in effects.items()}
    runs = {name: engine.run(np.array([2.0])) for name, engine in engines.items()}
    np.testing.assert_allclose(runs["own"].outputs, runs["built-in"].outputs, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(runs["own"].sensitivity, runs["built-in"].sensitivity, rtol=1e-6, atol=1e-9)


def dragged(n=2500, noise=0.01, seed=0, value=4.0):
    """Record of the chain with drag at link1."""
    model, data = chain(n, seed)
    engine = Engine(Structure(model, [rco.Effect("quadratic_damping", "link1")]), data, substeps=8)
    y = engine.run(np.array([value]), sensitivity=False).outputs
    rng = np.random.default_rng(seed + 1)
    return model, data, y + noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)


def test_a_registered_law_is_in_the_library_and_wins_a_diagnosis():
    loaded("power_drag")
    model, data, y = dragged()
    assert any(e.kind == "power_drag" for e in rco.effect_library(model))
    laws = ["stiffness", "damping", "coulomb_friction", "power_drag"]
    found = rco.diagnose(
        model,
        rco.Measurement(data.inputs, y, dt=data.dt, hold="foh"),
        candidates=[rco.Effect(kind, place) for kind in laws for place in ("link1", "link2")],
    )
    assert found.best is not None
    assert str(found.best.effect) == "power_drag at link1"
    assert found.best.coefficients["power"] == pytest.approx(2.0, abs=5 * found.best.std["power"] + 0.02)


@pytest.mark.parametrize("law", [Drag, drag], ids=["class", "function"])
def test_on_a_stream_a_users_law_gives_what_the_built_in_one_gives(law, tmp_path):
    model, data, y = dragged()
    effects = [rco.Effect("custom", "link1", law=law), rco.Effect("quadratic_damping", "link1")]
    values = []
    for effect in effects:
        refiner = rco.RCORefiner(model, dt=data.dt, hold="foh", effects=[effect])
        refiner.update(data.inputs[:, :1500], y[:, :1500])
        refiner.save(tmp_path / "state.npz")
        again = rco.RCORefiner.load(tmp_path / "state.npz")
        for one in (refiner, again):
            one.update(data.inputs[:, 1500:], y[:, 1500:])
        np.testing.assert_array_equal(refiner.static_theta, again.static_theta)
        values.append(np.ravel(refiner.static_theta)[0])
    assert values[0] == pytest.approx(values[1], rel=1e-3)
    assert values[1] == pytest.approx(4.0, rel=0.05)


def test_play_at_an_input_on_a_stream():
    module = loaded("actuator_play")
    data = module.record(3000)
    refiner = rco.RCORefiner(module.MODEL, dt=data.dt, hold="foh", effects=[effect_of("actuator_play")])
    refiner.update(data.inputs, data.outputs)
    assert np.ravel(refiner.static_theta)[0] == pytest.approx(0.7, rel=0.02)


def slow_valve(seed, hold, n=1500, dt=0.02, rate=3.0, fine=20, noise=0.01):
    """Command, and displacement of a mass behind an actuator of a largest speed; straight between nodes."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(n)
    steps = np.repeat(rng.uniform(-2.0, 2.0, n // 50), 50)
    w = steps if hold == "zoh" else 2.0 * np.sin(1.9 * t + rng.uniform(0, 6)) + np.sin(4.3 * t)
    reach, path = rate * dt / fine, [float(w[0])]
    for k in range(n - 1):
        for j in range(fine):
            target = w[k] if hold == "zoh" else w[k] + (j + 1) / fine * (w[k + 1] - w[k])
            path.append(path[-1] + min(max(float(target) - path[-1], -reach), reach))
    mass = [[0.0, 1.0], [-20.0, -0.8]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]]
    y = lsim(mass, path, dt / fine * np.arange(len(path)))[1][::fine]
    y += noise * y.std() * rng.standard_normal(n)
    return rco.Measurement(w, y, dt=dt, hold=hold)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_the_rate_of_an_actuator_is_found(hold):
    model, errors = rco.mass_spring_damper(1.0, 0.8, 20.0), []
    for seed in range(5):
        found = rco.refine(model, slow_valve(seed, hold), [rco.Effect("input_rate_limit", "force")])
        (row,) = [row for row in found.parameters if row.role == "effect"]
        errors.append((row.value - 3.0) / row.std)
        assert row.std < 0.05
    assert np.abs(errors).max() < 3.3  # of five normal ones, in 995 of 1000 cases
    assert np.sum(np.square(errors)) < 16.7  # chi-square of five, 99.5 %


def test_a_rate_is_told_from_a_lag_where_the_command_steps():
    model = rco.mass_spring_damper(1.0, 0.8, 20.0)
    kinds = ("input_rate_limit", "input_lag", "input_delay")
    # steps of any size, slow and fast actuators; a quiet sensor sees how the ramp runs inside a sample
    for seed, rate, noise in ((11, 3.0, 0.01), (13, 3.0, 0.01), (21, 0.6, 0.01), (31, 12.0, 0.001)):
        record = slow_valve(seed, "zoh", rate=rate, noise=noise)
        found = rco.diagnose(model, record, candidates=[rco.Effect(kind, "force") for kind in kinds])
        assert (found.verdict, found.best.effect.kind) == ("effect", "input_rate_limit")
        assert abs(found.best.coefficients["rate"] - rate) < 4 * found.best.std["rate"]


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_about_an_operating_point_a_rate_is_the_same(hold):
    plain, data = rco.mass_spring_damper(1.0, 0.8, 20.0), slow_valve(3, hold)
    about = rco.physical(plain, operating_point={"inputs": [50.0], "states": [2.5, 0.0]})
    absolute = rco.Measurement(data.inputs + 50.0, data.outputs + 2.5, dt=data.dt, hold=hold)
    found = []
    for model, record in ((plain, data), (about, absolute)):
        fit = rco.refine(model, record, [rco.Effect("input_rate_limit", "force")])
        found += [row for row in fit.parameters if row.role == "effect"]
    assert found[1].value == pytest.approx(found[0].value, abs=1e-3 * found[0].std)


def test_a_rate_is_refused_on_a_stream():
    model = rco.mass_spring_damper(1.0, 0.8, 20.0)
    with pytest.raises(rco.ModelError, match="time between samples"):
        rco.RCORefiner(model, dt=0.02, effects=[rco.Effect("input_rate_limit", "force")])


def test_a_monitor_watches_for_a_users_law():
    model, data, y = dragged(6000, value=30.0, seed=4)
    sound = Engine(Structure(model), data).run(np.zeros(0)).outputs
    rng = np.random.default_rng(9)
    sound = sound + 0.01 * sound.std(axis=1, keepdims=True) * rng.standard_normal(sound.shape)
    seen = np.where(np.arange(6000) < 4000, sound, y)
    monitor = rco.Monitor(
        model,
        [rco.Effect("custom", "link1", law=drag), rco.Effect("stiffness", "link2")],
        dt=data.dt,
        hold="foh",
        learn=2500,
    )
    monitor.update(data.inputs, seen)
    assert monitor.alarm is not None
    assert monitor.ranking[0].effect.law is drag


def test_pickles_and_equality():
    for law in (Drag, drag):
        effect = rco.Effect("custom", "link1", law=law)
        again = pickle.loads(pickle.dumps(effect))
        assert again == effect
        assert again.spec.code == effect.spec.code  # one compiled law in a process
    assert rco.Effect("drag", "link1", law=Drag) == rco.Effect("custom", "link1", law=Drag)


OUTSIDE = """
import sys
import numpy as np
import params
from rcorefine import Effect
from rcorefine.effects.effect import unit_forces

KNOTS = np.array([-5.0, 0.0, 5.0])

def own(d, v): return K * d**3
def of_module(d, v): return params.K * d
def of_table(d, v): return np.interp(d, KNOTS, VALUES)
def of_class(d, v): return params.Settings.K * d
def helper(d): return K * d
def helped(d, v): return helper(d)
def repeated(d, v):
    force = 0.0
    for _ in range(3):
        force += K * d / 3.0
    return force
def maker(k):
    def closure(d, v): return k * d
    return closure

effects = []
for value in sys.argv[1:]:
    K = params.K = params.Settings.K = float(value)
    VALUES = K * KNOTS
    laws = (own, of_module, of_table, of_class, helped, repeated, maker(K))
    effects = effects[:-1] or [Effect("custom", "link1", law=law) for law in laws[:-1]]
    effects.append(Effect("custom", "link1", law=laws[-1]))
    one = np.ones(1)
    print(*(float(unit_forces(effect, one, one, [{}])[0][0]) for effect in effects))
"""


def test_a_law_takes_the_constants_of_now(tmp_path):
    """In another process and later in the same one: each law is K at d = 1."""
    (tmp_path / "params.py").write_text("class Settings: pass\n")
    (tmp_path / "script.py").write_text(OUTSIDE)
    path = {**os.environ, "PYTHONPATH": str(Path(rco.__file__).parents[1])}
    for values in (("60", "90"), ("90",), ("60",)):
        done = subprocess.run(
            [sys.executable, "script.py", *values],
            capture_output=True, text=True, check=True, cwd=tmp_path, env=path,
        )  # fmt: skip
        found = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
        np.testing.assert_allclose(found, np.array(values, dtype=float)[:, None] * np.ones(7), rtol=1e-12)
    if NUMBA:  # compiled code is kept for each value that a process begins with
        assert 12 <= len(list((tmp_path / "__pycache__").glob("script.*.nbc"))) <= 14


def test_a_registered_law_unpickles_where_nobody_imported_it(tmp_path):
    loaded("power_drag")
    (tmp_path / "effect.pickle").write_bytes(pickle.dumps(rco.Effect("power_drag", "mass1")))
    script = "import pickle, sys; print(pickle.load(open(sys.argv[1], 'rb')))"
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "effect.pickle")],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": f"{DOCS}:{Path(rco.__file__).parents[1]}"},
    )
    assert done.stdout.strip() == "power_drag at mass1"


class TestWhatIsWrongIsSaid:
    def test_a_name_that_the_formula_cannot_have(self):
        class Wrong(PortLaw):
            """Typing error."""

            formula = explanation = "{place}."
            coefficients = (Coefficient("drag", "", explanation="drag"),)

            @staticmethod
            def law(v, dragg):
                return dragg * v

        with pytest.raises(ct.ControlArgument, match=r"'dragg'.*none of its coefficients.*drag"):
            rco.Effect("wrong", "link1", law=Wrong)

    def test_no_start(self):
        class Gap(InputLaw):
            """Without a start."""

            formula = explanation = "{place}."
            coefficients = (Coefficient("gap", "", default_start=None, explanation="gap"),)

            @staticmethod
            def law(w, gap):
                return w - gap

        with pytest.raises(ct.ControlArgument, match="no default_start"):
            rco.Effect("gap", "force", law=Gap)

    def test_no_formula(self):
        class Empty(PortLaw):
            """Nothing."""

            formula = explanation = "{place}."
            coefficients = ()

        with pytest.raises(ct.ControlArgument, match="no formula"):
            Structure(chain()[0], [rco.Effect("empty", "link1", law=Empty)]).laws(np.zeros(0))
        with pytest.raises(ct.ControlArgument, match="@staticmethod"):
            type("Bound", (PortLaw,), {"law": lambda v: v})

    def test_another_kind(self):
        with pytest.raises(ct.ControlArgument, match="'drag', not 'damping'"):
            rco.Effect("damping", "link1", law=Drag)

    @pytest.mark.skipif(not NUMBA, reason="in Python every law is called as it is")
    def test_a_law_that_cannot_be_compiled_is_called_in_python(self):
        table = {"rate": 2.0}

        def odd(d, v):
            return table["rate"] * v * abs(float(str(v)))  # symbols and numba have no text of a number

        model, data = chain(200)
        with pytest.warns(rco.RCOWarning, match="cannot be compiled"):
            code = rco.Effect("custom", "link1", law=odd).spec.code
        assert code
        own = Engine(Structure(model, [rco.Effect("custom", "link1", law=odd)]), data, substeps=2)
        outputs = own.run(np.array([1.0]), sensitivity=False).outputs
        same = Engine(Structure(model, [rco.Effect("quadratic_damping", "link1")]), data, substeps=2)
        expected = same.run(np.array([2.0]), sensitivity=False).outputs
        np.testing.assert_allclose(outputs, expected, rtol=1e-9, atol=1e-12)
        table.clear()
        with pytest.raises(KeyError, match="rate"):
            own.run(np.array([1.0]), sensitivity=False)


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (lambda d, v: np.nan, "returns nan wherever"),
        (lambda d, v: 1 / 0, "raises ZeroDivisionError wherever"),
        (lambda d, v: np.array([d, v]), "one real number"),
        (lambda d, v: "x", "one real number"),
    ],
    ids=["nan", "raises", "array", "text"],
)
def test_a_law_without_a_force_is_refused(law, said):
    with pytest.raises(ct.ControlArgument, match=said):
        rco.Effect("custom", "link1", law=law)


def test_a_law_may_have_a_pole_where_nothing_moves():
    assert rco.Effect("custom", "link1", law=lambda d, v: 1.0 / d).kind == "custom"


@pytest.mark.parametrize(("size", "power"), [(2e-4, 1.5), *slow((400.0, 4.0))])
def test_a_power_is_found_at_any_usual_motion(size, power):
    """The force at unit speed hangs on the power where the speed is far from one."""
    rng = np.random.default_rng(3)
    push = 0.2 * size * np.repeat(rng.standard_normal(50), 30) + 2.0 * size
    x, seen, h = size, np.empty(1500), 0.1 / 8

    def rate(x, u):  # half the push is lost at the usual motion
        return 0.2 * (u - x - size * np.sign(x) * np.abs(x / size) ** power)

    for k, u in enumerate(push):
        seen[k] = x
        for _ in range(8):  # Runge and Kutta
            a = rate(x, u)
            b = rate(x + h / 2 * a, u)
            c = rate(x + h / 2 * b, u)
            x += h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, u))
    model = ct.ss([[-0.2]], [[0.2]], [[1.0]], 0, states=["x"])
    data = rco.Measurement(push, seen + 1e-3 * seen.std() * rng.standard_normal(1500), dt=0.1)
    kinds = ("damping", "quadratic_damping", "power_damping")
    found = rco.diagnose(model, data, candidates=[rco.Effect(kind, "x") for kind in kinds])
    assert found.best.effect.kind == "power_damping"
    assert abs(found.best.coefficients["power"] - power) < 4 * found.best.std["power"]


def test_a_law_that_cannot_be_looked_up_is_taken():
    """An object with its own `__eq__` has no hash; its law is made anew each time."""

    class Cubic:
        __hash__ = None

        def __eq__(self, other):
            return True

        def __call__(self, d, v):
            return d**3

    effect = rco.Effect("custom", "link1", law=Cubic())
    assert effect.spec.law(2.0, 0.0) == 8.0
    assert effect.spec.coefficient_names == ("scale",)
