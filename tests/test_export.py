"""Refined models as programs of other languages, run where that can be."""

from __future__ import annotations

import ctypes
import math
import re
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from math import tanh

import control as ct
import numpy as np
import pytest
from inner import KINDS, FormulaLaw, Structure, nonlinear_system

import rcorefine as rco
from rcorefine.export.equations import equations_of
from rcorefine.export.programs import PROGRAMS

LAWS = [
    name
    for name, law in KINDS.items()
    if isinstance(law, FormulaLaw) and not law.delays and not law.needs_law and not law.feels_inputs
]
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def record(n: int = 2000, dt: float = 0.002) -> rco.Measurement:
    """Steps so short that the march's own error, of second order in them, is below 1e-6."""
    rng = np.random.default_rng(0)
    force = 8.0 * np.convolve(rng.standard_normal(n), np.ones(40) / 40, "same")
    return rco.Measurement(force, np.zeros(n), dt=dt, hold="foh")


def fitted(effects=("cubic_stiffness", "damping"), stiffness: float = 25.0) -> rco.Refinement:
    model, data = rco.mass_spring_damper(1.0, 0.8, 25.0), record()
    y = rco.simulate(rco.mass_spring_damper(1.0, 0.9, 27.0), data, "zero").outputs
    data = rco.Measurement(data.inputs, y, dt=data.dt, hold="foh")
    return rco.refine(model, data, [rco.Effect(kind, "link1") for kind in effects])


@pytest.fixture(scope="module")
def better() -> rco.Refinement:
    return fitted()


def structure(kind: str) -> tuple[Structure, np.ndarray]:
    """A law at a place of a two-mass model, coefficients at random within their bounds."""
    law = KINDS[kind]
    model = rco.mass_spring_damper([1.0, 0.5], [0.3, 0.2], [20.0, 30.0])
    linear = model.linear
    place = "link1"
    if law.at_channel:
        place = (linear.input_labels if "input" in law.where else linear.output_labels)[0]
    elif "entry" in law.where:
        place = {"state_dependent_gain": "B[2,0]", "product_of_states": "A[2,1]"}[kind]
    elif "mechanical" not in law.where:
        model, place = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), "x[0]"
    rng = np.random.default_rng(len(kind))
    start = {}
    for c in law.coefficients:
        low, high = max(c.lower, 0.1), min(c.upper, 2.0)
        start[c.name] = low + (high - low) * rng.random()
    for first, second in law.order:
        start[first] = max(start[first], start[second]) + 0.1
    built = Structure(model, [rco.Effect(kind, place, start=start)])
    return built, built.start()


# ---------------------------------------------------------------- Python
def test_the_python_file_runs_without_rcorefine_and_simulates_the_same(better, tmp_path):
    path, out = tmp_path / "refined.py", tmp_path / "out.npz"
    assert better.to_python(path) == path.read_text()
    code = (
        "import runpy, sys, numpy as np, control as ct\n"
        f"system = runpy.run_path({str(path)!r})['system']\n"
        f"t, u = np.load({str(tmp_path / 'in.npz')!r}).values()\n"
        "tight = {'rtol': 1e-10, 'atol': 1e-12, 'max_step': t[1]}\n"
        "answer = ct.input_output_response(system, t, u, solve_ivp_kwargs=tight)\n"
        "assert not [name for name in sys.modules if name.startswith('rcorefine')]\n"
        f"np.savez({str(out)!r}, y=answer.y)\n"
    )
    data = record()
    np.savez(tmp_path / "in.npz", t=data.timepts, u=data.inputs)
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300, cwd=tmp_path)
    ours = better.simulate(data, "zero").y
    np.testing.assert_allclose(np.load(out)["y"].reshape(ours.shape), ours, atol=1e-6 * np.abs(ours).max())


def test_estimates_and_their_errors_stand_in_comments(better):
    for text in (better.to_python(), better.to_c(), better.to_matlab()):
        for row in better.parameters:
            assert f"{row.name} at {row.place}: {row.value:.6g} +- {row.std:.2g}" in text


@pytest.mark.parametrize("kind", LAWS)
def test_every_law_in_python(kind):
    built, theta = structure(kind)
    try:
        expected = nonlinear_system(built, theta)
    except rco.ModelError:
        with pytest.raises(rco.ModelError):
            equations_of(built, theta, ())
        return
    space: dict = {}
    exec(PROGRAMS["Python"](equations_of(built, theta, ())), space)
    same(expected, space["system"].dynamics, space["system"].output, rtol=1e-12)


def same(expected, rates, outputs, rtol):
    rng = np.random.default_rng(1)
    for _ in range(20):
        x, u = rng.standard_normal(expected.nstates), 2 * rng.standard_normal(expected.ninputs)
        for ours, theirs in ((rates, expected.dynamics), (outputs, expected.output)):
            np.testing.assert_allclose(ours(0.0, x, u), theirs(0.0, x, u), rtol=rtol, atol=rtol)


# ---------------------------------------------------------------- C
@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
def test_every_law_in_c(tmp_path):
    """One library of all laws, against the system that python-control simulates."""
    cases, sources = [], []
    for kind in LAWS:
        built, theta = structure(kind)
        try:
            expected = nonlinear_system(built, theta)
        except rco.ModelError:
            continue
        equations = equations_of(built, theta, ())
        text = PROGRAMS["C"](equations)
        stem = re.search(r"void (\w+)_rhs", text)[1]
        path = tmp_path / f"{kind}.c"
        path.write_text(
            text.replace(f"{stem}_rhs", f"{kind}_rhs").replace(f"{stem}_output", f"{kind}_output")
        )
        sources.append(path)
        cases.append((kind, expected))
    library = tmp_path / "laws.so"
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC"]
    subprocess.run([COMPILER, *flags, *map(str, sources), "-o", str(library), "-lm"], check=True, timeout=300)
    loaded = ctypes.CDLL(str(library))
    assert len(cases) > 15
    for kind, expected in cases:

        def call(which, size, kind=kind):
            function = getattr(loaded, f"{kind}_{which}")
            row = np.ctypeslib.ndpointer(float)
            function.argtypes, function.restype = [ctypes.c_double, row, row, row], None

            def at(t, x, u):
                found = np.zeros(size)
                function(t, np.ascontiguousarray(x), np.ascontiguousarray(u), found)
                return found

            return at

        same(expected, call("rhs", expected.nstates), call("output", expected.noutputs), rtol=1e-11)


# ---------------------------------------------------------------- MATLAB
@pytest.mark.parametrize("kind", LAWS)
def test_every_law_has_its_words(kind):
    built, theta = structure(kind)
    try:
        text = PROGRAMS["MATLAB"](equations_of(built, theta, ()))
    except rco.ModelError as error:
        assert re.search("no differential equation|not written in", str(error))  # noqa: PT017
        return
    assert text.count("(") == text.count(")")
    assert not re.search(r"\*\*|math\.|np\.|nan|inf\b|None|True", text)


def test_the_heads_of_programs(better):
    assert better.to_matlab().startswith("function [dx, y] = chain(t, x, u)\n%")


# ---------------------------------------------------------------- laws of a user
class Settings:
    e, width = 3.0, -0.5


LIMIT = -0.25


def either(d, v):
    return 2.0 * (d or v)


def both(d, v):
    return 2.0 * (d and v and 1.5)


def conditions(d, v):
    up = not d
    if v and not d < LIMIT:
        up = (d > 0) + up
    return v * up + (3.0 if d else 1.0) + (v != 0)


def in_decades(d, v):
    return math.log(abs(d) + 1.0, 10) + math.log(2.0 + abs(v), 1.0 + abs(d) + 0.1)


def longer(d, v):
    return math.hypot(d, v, 2.0) + max(d, v, LIMIT, 0.1) - min(v, LIMIT, d) - -d


def attributes(d, v):
    return Settings.e * d + math.e * v - Settings.width * abs(d) + tanh(np.exp(-abs(v)))


def by_default(d, v, k=-2.0, unused="x", other=0.5):
    k = 2.0 * k
    return k * d + other * v


def between(d, v, k=3.0, rate=1.0):
    return k * d + rate * v


def by_name(d, v, *, rate, k=3.0):
    return k * d + rate * v


def words(d, v, inline, restrict, INFINITY, exp):
    inline_ = inline + 1.0
    return inline_ * d + restrict * v + INFINITY * math.exp(-exp * abs(d))


def letters(d, v, ζ, _end):
    end = ζ * d
    return end + _end * v


OWN = {
    law: tuple(names)
    for law, *names in (
        (either,), (both,), (conditions,), (in_decades,), (longer,), (attributes,), (by_default,),
        (between, "rate"), (by_name, "rate"), (words, "inline", "restrict", "INFINITY", "exp"),
        (letters, "ζ", "_end"),
    )
}  # fmt: skip


def of_own(law, system="chain"):
    """Equations of a mass with the law, and the coefficients."""
    model = rco.mass_spring_damper(1.0, 0.8, 25.0)
    start = dict(zip(OWN[law], (1.25, 0.5, 2.0, 0.75), strict=False))
    built = Structure(model, [rco.Effect("custom", "link1", law=law, start=start or {"scale": 1.0})])
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "custom cannot be compiled")  # as numba knows no such function
        return replace(equations_of(built, built.start(), ()), name=system), start


def forces(law, start, rhs):
    """What the law adds to the acceleration of the mass: minus its force, by the program and by Python."""
    rng = np.random.default_rng(5)
    points = [(0.0, 0.0), (0.0, 0.7), (-0.4, 0.0), *rng.standard_normal((20, 2)).tolist()]
    found = [-float(rhs(0.0, np.array(x), np.zeros(1))[1]) - 25.0 * x[0] - 0.8 * x[1] for x in points]
    np.testing.assert_allclose(found, [law(*x, **start) for x in points], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("law", OWN)
def test_a_users_law_in_python(law):
    equations, start = of_own(law)
    space: dict = {}
    exec(PROGRAMS["Python"](equations), space)
    forces(law, start, space["system"].dynamics)


@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
@pytest.mark.parametrize("standard", ["c99", "gnu17"])
def test_users_laws_in_c(tmp_path, standard):
    sources = []
    for law in OWN:
        sources.append(tmp_path / f"{law.__name__}.c")
        sources[-1].write_text(PROGRAMS["C"](of_own(law, law.__name__)[0]))
    library = tmp_path / "own.so"
    flags = [f"-std={standard}", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([COMPILER, *flags, *map(str, sources), "-o", str(library), "-lm"], check=True, timeout=300)
    loaded, row = ctypes.CDLL(str(library)), np.ctypeslib.ndpointer(float)
    for law in OWN:
        function = getattr(loaded, f"{law.__name__}_rhs")
        function.argtypes, function.restype = [ctypes.c_double, row, row, row], None

        def rhs(t, x, u, function=function):
            found = np.zeros(2)
            function(t, x, u, found)
            return found

        forces(law, of_own(law)[1], rhs)


def test_users_laws_in_other_languages():
    """No name is a reserved word, no number a condition, no condition a number."""
    matlab = PROGRAMS["MATLAB"](of_own(either)[0])
    assert "result = (2.0 * pick((d ~= 0.0), d, v)); return;" in matlab
    inner = "pick((v ~= 0.0), 1.5, v)"
    assert f"result = (2.0 * pick((d ~= 0.0), {inner}, d)); return;" in PROGRAMS["MATLAB"](of_own(both)[0])
    assert "log((abs(d) + 1.0)) / log(10.0)" in PROGRAMS["MATLAB"](of_own(in_decades)[0])
    text = PROGRAMS["MATLAB"](of_own(letters)[0])
    assert re.search(r"end_ = \(u3b6|end_ = \(vu3b6", text)
    assert "v_end * v" in text
    assert text.isascii()
    assert "- -" not in PROGRAMS["MATLAB"](of_own(longer)[0])


def shadowed(d, v):
    return Settings.tanh(d)


Settings.tanh = staticmethod(lambda x: 7.0 * x)


def far(d, v):
    return d + min(v, math.inf)


@pytest.mark.parametrize("law", [shadowed, far])
def test_what_only_looks_like_a_function_of_math_is_refused(law):
    built = Structure(rco.mass_spring_damper(1.0, 0.8, 25.0), [rco.Effect("custom", "link1", law=law)])
    for language in ("C", "MATLAB"):
        with pytest.raises(rco.ModelError, match=f"not written in {language}"):
            PROGRAMS[language](equations_of(built, built.start(), ()))


# ---------------------------------------------------------------- what cannot be written
def test_what_has_no_state_equation_is_named():
    model = rco.mass_spring_damper(1.0, 0.8, 25.0)
    built = Structure(model, [rco.Effect("input_delay", "force", start={"delay": 0.05})])
    with pytest.raises(rco.ModelError, match="input delay|input_delay"):
        equations_of(built, built.start(), ())


def jagged(d, v):
    total = 0.0
    for _ in range(3):
        total += d
    return total


def test_a_law_that_a_language_has_no_words_for_is_named():
    model = rco.mass_spring_damper(1.0, 0.8, 25.0)
    for law, message in ((jagged, "not written in C"), (eval("lambda d, v: d"), "source of its law")):
        built = Structure(model, [rco.Effect("custom", "link1", law=law)])
        equations = equations_of(built, built.start(), ())
        with pytest.raises(rco.ModelError, match=message):
            PROGRAMS["C"](equations)


@pytest.mark.parametrize("method", ["to_python", "to_c", "to_matlab"])
def test_a_path_that_is_none(better, method):
    with pytest.raises(ct.ControlArgument, match="path"):
        getattr(better, method)(7)
    with pytest.raises(OSError):
        getattr(better, method)("/no/such/folder/x")
