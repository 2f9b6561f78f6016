"""What `import rcorefine` offers: names, docstrings, keywords, and nothing heavy."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import pkgutil
import re
import subprocess
import sys
import tempfile
import types
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import control as ct
import numpy as np
import pandas as pd
import pytest
from numpydoc.docscrape import NumpyDocString
from scipy.io import savemat

import rcorefine as rco
from rcorefine.commands.cli import _COMMANDS
from rcorefine.conftest import collect_ignore
from rcorefine.diagnosis.experiments import ExperimentAdvice

HEAVY = ["pandas", "statsmodels", "dask", "distributed", "harold", "sklearn", "h5py", "IPython", "pytest"]

# What takes **keywords, called with one that does not exist.


def _read_with_unknown_keyword(kind: str) -> object:
    """A record from each sort of source."""
    columns = {"t": 0.1 * np.arange(9), "u": np.arange(9.0), "y": np.arange(9.0)}
    if kind == "frame":
        return rco.Measurement.from_frame(pd.DataFrame(columns), "u", "y", dt=0.1, no_such_keyword=1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"record.{kind}")
        if kind == "csv":
            path.write_text("t,u,y\n" + "".join(f"{0.1 * k},{k},{k}\n" for k in range(9)))
        elif kind == "npz":
            np.savez(path, **columns)
        else:
            savemat(path, columns)
        return getattr(rco.Measurement, f"from_{kind}")(path, "u", "y", dt=0.1, no_such_keyword=1)


WITH_KEYWORDS: dict[str, Callable[[], object]] = {
    "RCORefiner": lambda: rco.RCORefiner(ct.ss([[-1.0]], [[1.0]], [[1.0]], 0), dt=0.1, no_such_keyword=1),
    "Effect.replace": lambda: rco.Effect("damping", "x").replace(no_such_keyword=1),
    "Measurement.from_csv": lambda: _read_with_unknown_keyword("csv"),
    "Measurement.from_frame": lambda: _read_with_unknown_keyword("frame"),
    "Measurement.from_mat": lambda: _read_with_unknown_keyword("mat"),
    "Measurement.from_npz": lambda: _read_with_unknown_keyword("npz"),
    "Measurement.from_hdf5": lambda: _read_with_unknown_keyword("hdf5"),
    "Measurement.from_uff": lambda: rco.Measurement.from_uff("none.uff", 0, 1, no_such_keyword=1),
    "FrequencyResponse.from_csv": lambda: rco.FrequencyResponse.from_csv(
        "none.csv", "f", "H", "phase", no_such_keyword=1
    ),
    "FrequencyResponse.from_frd": lambda: rco.FrequencyResponse.from_frd(
        ct.frd([1.0], [1.0]), no_such_keyword=1
    ),
    "FrequencyResponse.from_uff": lambda: rco.FrequencyResponse.from_uff("none.uff", no_such_keyword=1),
    "Measurement.from_benchmark": lambda: rco.Measurement.from_benchmark(
        SimpleNamespace(u=np.ones(9), y=np.ones(9), sampling_time=1.0), no_such_keyword=1
    ),
    "Measurement.from_timestamps": lambda: rco.Measurement.from_timestamps(
        np.arange(9.0), np.zeros(9), np.zeros(9), no_such_keyword=1
    ),
}
# Rows of a table: nobody makes them by hand, the object that holds them has the example.
ROWS = {"NominalParameter"}


def public_objects() -> dict[str, Any]:
    return {name: getattr(rco, name) for name in rco.__all__}


def is_own_exception(obj: Any) -> bool:
    return isinstance(obj, type) and issubclass(obj, Exception)


CALLABLES = {
    name: obj for name, obj in public_objects().items() if callable(obj) and not is_own_exception(obj)
}


def with_methods() -> dict[str, Any]:
    """Public callables, and the public methods that the classes among them define or have as a result."""
    found = dict(CALLABLES)
    for name, obj in CALLABLES.items():
        if not isinstance(obj, type):
            continue
        shown = [base for base in obj.__mro__[1:] if base.__module__.startswith("rcorefine.")]
        for attribute, raw in [item for base in (*shown, obj) for item in vars(base).items()]:
            if attribute.startswith("_") or isinstance(raw, property):
                continue
            method = getattr(obj, attribute)
            if inspect.isroutine(method):
                found[f"{name}.{attribute}"] = method
    return found


WITH_METHODS = with_methods()


def sections(obj: Any) -> NumpyDocString:
    return NumpyDocString(inspect.getdoc(obj) or "")


def documented(doc: NumpyDocString, *titles: str) -> set[str]:
    """Names in these sections; `a, b : float` documents both."""
    return {
        name.strip().lstrip("*")
        for title in titles
        for entry in doc[title]
        for name in entry.name.split(",")
        if name.strip()
    }


def parameters(obj: Any) -> dict[str, inspect.Parameter]:
    found = dict(inspect.signature(obj).parameters)
    if "." in getattr(obj, "__qualname__", "") and not isinstance(obj, type):
        found.pop("self", None)
    return found


def test_every_public_name_exists_once():
    missing = [name for name in rco.__all__ if not hasattr(rco, name)]
    assert not missing
    assert len(set(rco.__all__)) == len(rco.__all__)


def test_no_name_leaks():
    """`rco.<tab>` shows the public names and submodules, never `np` or a helper."""
    shown = {name for name in vars(rco) if not name.startswith("_")}
    submodules = {module.name for module in pkgutil.iter_modules(rco.__path__)}
    assert shown - set(rco.__all__) - submodules == set()
    for name in submodules & set(rco.__all__):
        assert inspect.ismodule(getattr(rco, name)), f"{name} hides the submodule of the same name"


def test_version_is_a_release_number():
    parts = rco.__version__.split(".")
    assert len(parts) == 3
    assert all(part.isdigit() for part in parts)


def test_modules_export_what_they_define():
    """A name in a module's `__all__` exists there."""
    ignored = {f"rcorefine.{name.removesuffix('.py').replace('/', '.')}" for name in collect_ignore}
    for info in pkgutil.walk_packages(rco.__path__, "rcorefine."):
        if info.name.endswith(("conftest", "__main__")) or info.name in ignored:
            continue
        module = importlib.import_module(info.name)
        for name in getattr(module, "__all__", ()):
            assert hasattr(module, name), f"{info.name}.__all__ names {name!r}, which does not exist"


def test_bare_import_is_light():
    code = f"import json, sys, rcorefine; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []


def test_package_is_marked_as_typed():
    from importlib.resources import files

    assert files("rcorefine").joinpath("py.typed").is_file()


@pytest.mark.parametrize("name", sorted(rco.__all__))
def test_docstring_has_a_summary(name):
    obj = getattr(rco, name)
    summary = " ".join(sections(obj)["Summary"]) if not inspect.ismodule(obj) else (obj.__doc__ or "")
    assert summary.strip(), f"{name} has no summary line"
    if not inspect.ismodule(obj):
        assert summary.strip().endswith((".", ":")), f"{name}: the summary is no sentence: {summary!r}"


@pytest.mark.parametrize("name", sorted(WITH_METHODS))
def test_every_parameter_is_documented(name):
    obj = WITH_METHODS[name]
    doc = sections(obj)
    signature = set(parameters(obj))
    # a result is made by the toolbox, not by the user: its fields may stand under Attributes
    result = isinstance(obj, type) and dataclasses.is_dataclass(obj)
    titles = ("Parameters", "Other Parameters", *(("Attributes",) if result else ()))
    undocumented = signature - documented(doc, *titles)
    assert not undocumented, f"{name} does not document {sorted(undocumented)}"
    unknown = documented(doc, "Parameters", "Other Parameters") - signature
    assert not unknown, f"{name} documents {sorted(unknown)}, which it does not take"


@pytest.mark.parametrize(
    "name", sorted(name for name, obj in WITH_METHODS.items() if not isinstance(obj, type))
)
def test_what_is_returned_is_documented(name):
    obj = WITH_METHODS[name]
    if inspect.signature(obj).return_annotation in ("None", None, inspect.Signature.empty):
        return
    doc = sections(obj)
    assert doc["Returns"] or doc["Yields"], f"{name} does not say what it returns"


@pytest.mark.parametrize("name", sorted(name for name in CALLABLES if not name.endswith("Warning")))
def test_docstring_has_an_example(name):
    """Runnable: pytest executes the examples of the package as doctests."""
    obj = CALLABLES[name]
    if name in ROWS:
        return
    if isinstance(obj, type) and dataclasses.is_dataclass(obj) and not sections(obj)["Parameters"]:
        return  # a result: the function that makes it has the example
    assert sections(obj)["Examples"], f"{name} has no example"


@pytest.mark.parametrize("name", sorted(WITH_METHODS))
def test_unknown_keyword_is_refused(name):
    """By Python itself, or by the function where it takes ``**keywords``."""
    obj = WITH_METHODS[name]
    if any(item.kind is inspect.Parameter.VAR_KEYWORD for item in parameters(obj).values()):
        assert name in WITH_KEYWORDS, (
            f"{name} takes **keywords: add a call with an unknown one to WITH_KEYWORDS"
        )
        with pytest.raises(TypeError, match="no_such_keyword"):
            WITH_KEYWORDS[name]()
    else:
        with pytest.raises(TypeError, match="no_such_keyword"):
            inspect.signature(obj).bind_partial(no_such_keyword=1)


@pytest.mark.parametrize("name", sorted(WITH_METHODS))
def test_signature_is_annotated(name):
    obj = WITH_METHODS[name]
    bare = [key for key, item in parameters(obj).items() if item.annotation is inspect.Parameter.empty]
    assert not bare, f"{name}: no type for {bare}"


def test_errors_are_what_python_users_expect():
    assert issubclass(rco.DataError, ValueError)
    assert issubclass(rco.ModelError, ValueError)
    assert issubclass(rco.DivergenceError, ArithmeticError)
    assert issubclass(rco.MissingExtraError, ImportError)
    errors = [obj for name, obj in public_objects().items() if name.endswith("Error")]
    assert all(issubclass(error, rco.RCOError) for error in errors)
    told = [obj for name, obj in public_objects().items() if name.endswith("Warning")]
    assert all(issubclass(warning, rco.RCOWarning) for warning in told)


def test_examples_is_a_module_of_examples():
    if "examples" in rco.__all__:
        assert isinstance(rco.examples, types.ModuleType)


ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.notebook
@pytest.mark.usefixtures("without_pictures")
def test_readme_example_runs(tmp_path, monkeypatch, capsys):
    """The first example of the README, line by line as it stands."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    assert blocks
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    before, after = names["result"].fit
    assert before[0] < 50
    assert after[0] > 97.5  # noise of 2 % leaves a fit of 98 %
    lines = capsys.readouterr().out.splitlines()
    shown = re.search(r"It prints, among others:\n+```\n(.*?)\n```", text, flags=re.DOTALL)
    assert shown is not None
    for part in shown[1].split("\n...\n"):
        expected = part.splitlines()
        starts = range(len(lines) - len(expected) + 1)
        assert any(all(map(prints_as, expected, lines[at:])) for at in starts), part


_NUMBER = re.compile(r"(?<![\w.\[-])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def prints_as(expected: str, line: str) -> bool:
    """The same words, and numbers that differ by one in the last digit shown, as other machines round."""
    figures = [_NUMBER.findall(one) for one in (expected, line)]
    if len(figures[0]) != len(figures[1]):
        return False
    unit = [Decimal(1).scaleb(int(Decimal(one).as_tuple().exponent)) for one in figures[0]]
    near = all(abs(Decimal(a) - Decimal(b)) <= u for a, b, u in zip(*figures, unit, strict=True))
    words = [_NUMBER.sub("#", one).split() for one in (expected, line)]
    return near and words[0] == words[1]


@pytest.mark.parametrize(
    ("line", "same"),
    [
        ("y[0]  31.5  0.00459", True), ("y[0]  31.6  0.00458", False), ("y[1]  31.4  0.00458", False),
        ("y[0]  31.4  0.00458  1", False), ("y[0] 31.4 -0.00458", False),
    ],
)  # fmt: skip
def test_a_printed_line_may_differ_in_its_last_digit_only(line, same):
    assert prints_as("y[0]  31.4  0.00458", line) == same


def test_rates_of_the_readme_are_those_that_were_measured():
    """The numbers of each sentence stand together in one paragraph or row of docs/rates.md."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    rates = (ROOT / "docs" / "rates.md").read_text(encoding="utf-8")
    measured = [set(_NUMBER.findall(part)) for part in re.split(r"\n\n|\n(?=[|-])", rates)]
    sentences = re.findall(
        r"^- (.*)$", readme.split("## How far to trust it")[1].split("\n## ")[0], re.MULTILINE
    )
    assert len(sentences) == 3
    for sentence in sentences:
        figures = set(_NUMBER.findall(sentence.replace("95 % interval", "")))
        assert any(figures <= there for there in measured), sentence
    count = len(list((ROOT / "notebooks").glob("*.ipynb")))
    words = "zero one two three four five six seven eight nine ten eleven twelve".split()
    assert f"({words[count]}, with their outputs)" in readme


def test_what_the_readme_promises_of_results_and_of_the_terminal():
    """Every result of the table has a picture and a report; the terminal has the verbs that are named."""
    named = (
        "Check Comparison Diagnosis Improvement Refinement Confirmation DamageMap RCORefiner Monitor Survey"
    )
    for kind in [*(getattr(rco, name) for name in named.split()), ExperimentAdvice]:
        assert callable(kind.plot), kind
        assert callable(kind.report), kind
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    said = readme.split("The terminal has ")[1].split("record.csv")[0]
    verbs = set(re.findall(r"`([a-z]+)`", said))
    assert verbs | {"demo", "explore", "example"} == set(_COMMANDS)


def test_readme_opens_with_the_two_commands():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    block = re.search(r"^## Two commands\n+```\w*\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    assert block is not None
    assert block.group(1).splitlines() == [
        'python -m pip install ".[all]" && rcorefine demo',
        'python -m pip install ".[all,dev]" && python -m pytest',
    ]


def test_readme_names_what_exists():
    """Files that it links to, and public names in the table of pieces."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", text):
        assert (ROOT / target).exists(), f"README links to {target}, which does not exist"
    table = text.split("## What each piece does")[1].split("\n\n")[1]
    for row in table.splitlines()[2:]:
        for name in re.findall(r"`([A-Za-z_][\w.]*)`", row.split("|")[2]):
            obj: Any = rco
            for part in name.split("."):
                assert hasattr(obj, part), f"README names {name}, which does not exist"
                obj = getattr(obj, part)
    assert len(text.split()) <= 900
