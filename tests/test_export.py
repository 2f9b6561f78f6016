"""Refined models as programs of other languages, run where that can be."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import sys

import control as ct
import numpy as np
import pytest

import rcorefine as rco
from rcorefine.effects.formula import FormulaLaw
from rcorefine.effects.law import KINDS
from rcorefine.engine.nonlinear import nonlinear_system
from rcorefine.engine.structure import Structure
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
    for text in (better.to_python(), better.to_c(), better.to_matlab(), better.to_modelica()):
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


# ---------------------------------------------------------------- MATLAB, Modelica
@pytest.mark.parametrize("language", ["MATLAB", "Modelica"])
@pytest.mark.parametrize("kind", LAWS)
def test_every_law_has_its_words(kind, language):
    built, theta = structure(kind)
    try:
        text = PROGRAMS[language](equations_of(built, theta, ()))
    except rco.ModelError as error:
        assert re.search("no differential equation|not written in", str(error))  # noqa: PT017
        return
    assert text.count("(") == text.count(")")
    assert not re.search(r"\*\*|math\.|np\.|nan|inf\b|None|True", text)


def test_the_heads_of_programs(better):
    assert better.to_matlab().startswith("function [dx, y] = chain(t, x, u)\n%")
    text = better.to_modelica()
    assert text.startswith("model chain\n")
    assert text.rstrip().endswith("end chain;")
    assert "der(x[2]) =" in text


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


@pytest.mark.parametrize("method", ["to_python", "to_c", "to_matlab", "to_modelica"])
def test_a_path_that_is_none(better, method):
    with pytest.raises(ct.ControlArgument, match="path"):
        getattr(better, method)(7)
    with pytest.raises(OSError):
        getattr(better, method)("/no/such/folder/x")
