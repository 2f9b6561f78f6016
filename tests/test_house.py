"""The layout of the package: imports run down one list, nobody imports pictures, results show themselves."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import io
import pkgutil
import textwrap
import tokenize
from pathlib import Path

import pytest

import rcorefine as rco
from rcorefine import results
from rcorefine.conftest import collect_ignore
from rcorefine.effects.law import KINDS

PACKAGE = Path(rco.__file__).parent
#: Each may import those before it, and none after it.
ORDER = (
    "version", "exceptions", "extras", "arithmetic", "jit", "arguments", "progress", "writing", "archives",
    "words", "results", "systems", "bordered", "gauss_newton", "data", "effects", "models", "engine",
    "export", "inference", "comparison", "refinement", "diagnosis", "localization", "fleet", "streaming",
    "examples", "exercises", "views", "explorer", "commands", "__main__",
)  # fmt: skip


#: A file holds one idea: at most so many lines.
MOST_LINES = 350
#: Files that are longer, and why.
LONGER = {
    "engine/kernels.py": "the march: one compiled loop",
}

#: A function says one thing: at most so many lines of code, and so many ways through it.
MOST_CODE, MOST_WAYS = 60, 20
#: The marches, compiled: what they call is inlined, and a call in Python would cost more than it clears.
MARCHES = {"engine/kernels.py: march", "streaming/coefficients/kernel.py: advance"}
#: Others that are larger, and why.
LARGER = {
    "effects/compiled.py: _source": "the text of the C function that a law becomes",
    "streaming/free_run.py: free_run_cost": "the march of the free run, compiled",
    "streaming/monitor/bank.py: _columns": "the columns of the bank, which enter a compiled march",
    "streaming/monitor/kernels.py: scores": "the march of the monitor, compiled",
}


@functools.cache
def files() -> dict[str, tuple[str, ast.Module]]:
    """Text and syntax tree of each file of the package."""
    texts = {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in PACKAGE.rglob("*.py")}
    return {name: (text, ast.parse(text)) for name, text in sorted(texts.items())}


def module_of(file: str) -> str:
    return f"rcorefine.{file.removesuffix('.py').replace('/', '.')}".removesuffix(".__init__")


@functools.cache
def imports() -> dict[str, set[str]]:
    """Modules of the package that each module imports, inside functions too; not what is for types only."""
    every = {module_of(file): file for file in files() if file != "conftest.py"}
    found: dict[str, set[str]] = {}
    for module, file in every.items():
        tree = files()[file][1]
        typing = {
            id(inner)
            for node in ast.walk(tree)
            if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
            for inner in ast.walk(node)
        }
        parents = module.split(".") if file.endswith("__init__.py") else module.split(".")[:-1]
        found[module] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                found[module] |= {name.name for name in node.names} & every.keys()
            elif isinstance(node, ast.ImportFrom) and id(node) not in typing:
                above = parents[: len(parents) + 1 - node.level] if node.level else []
                base = ".".join([*above, *([node.module] if node.module else [])])
                for name in node.names:
                    inner = f"{base}.{name.name}"
                    found[module] |= {inner if inner in every else base} & every.keys() - {module}
    return found


def part(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def test_every_module_has_its_place():
    assert {part(module) for module in imports()} - {""} == set(ORDER)


def test_imports_run_down_the_list():
    place = {name: k for k, name in enumerate(ORDER)}
    up = [
        f"{module} imports {other}"
        for module, others in imports().items()
        for other in others
        if module != "rcorefine" and (other == "rcorefine" or place[part(module)] < place[part(other)])
    ]
    assert up == []


def test_nobody_imports_views_but_the_face_the_explorer_and_the_commands():
    asked = {
        part(module) for module, others in imports().items() for other in others if part(other) == "views"
    }
    assert asked <= {"", "views", "explorer", "commands"}


def test_no_module_imports_itself_by_a_detour():
    below = imports()
    done: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in done:
            for other in sorted(below[module]):
                visit(other, (*way, module))
            done.add(module)

    for module in below:
        visit(module, ())


#: Words that are the name of an effect too, where they mean something else: a heading, an argument.
_HOMONYMS = {
    "coefficient": {
        "diagnosis/stepwise/backward.py", "diagnosis/stepwise/selection.py",
        "fleet/tasks.py", "models/physical_model.py", "streaming/coefficients/entries.py",
        "views/data.py", "views/diagnosis.py", "views/exercises.py", "views/experiment.py",
        "views/improvement.py", "views/monitor.py", "views/pages/diagnosis.py", "views/pages/survey.py",
        "views/survey.py",
    },
    "damping": {"localization/localize.py"},
    "mass": {"models/detection.py"},
}  # fmt: skip


def test_no_kind_of_effect_is_named_where_laws_do_not_live():
    """Others ask a law for its attributes, or import its class: a new law needs no other file."""
    free = ("effects/", "models/builders/", "examples/", "exercises/", "commands/")
    named = []
    for file, (_, tree) in files().items():
        if file.startswith(free):
            continue
        words = [
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in KINDS
        ]
        meant = [word for word in set(words) if file in _HOMONYMS.get(word, ())]
        for word in meant:  # once each
            words.remove(word)
        named += [f"{file}: {word}" for word in words]
    assert named == []


def test_no_file_is_longer_than_one_idea():
    lengths = {file: text.count("\n") for file, (text, _) in files().items()}
    assert {name: n for name, n in lengths.items() if n > MOST_LINES and name not in LONGER} == {}
    assert LONGER.keys() <= lengths.keys()


def size(function: ast.FunctionDef, source: str) -> int:
    """Lines of code: no docstring, no comment, no blank."""
    text = "\n".join(source.split("\n")[function.lineno - 1 : function.end_lineno])
    if text.count("\n") < MOST_CODE:
        return 0
    silent = {
        tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
    }  # fmt: skip
    lines = {
        line
        for token in tokenize.generate_tokens(io.StringIO(textwrap.dedent(text)).readline)
        if token.type not in silent
        for line in range(token.start[0], token.end[0] + 1)
    }
    return len(lines) - len((ast.get_docstring(function, clean=False) or "").splitlines())


def ways(function: ast.AST) -> int:
    """Ways through a function, as McCabe counts them (ruff's C901)."""
    branches = (ast.If, ast.For, ast.While, ast.ExceptHandler, ast.FunctionDef)
    count = sum(isinstance(node, branches) for node in ast.walk(function))
    for node in ast.walk(function):
        count += bool(getattr(node, "orelse", [])) and isinstance(node, (ast.For, ast.While, ast.Try))
        if isinstance(node, ast.Match):
            count += len(node.cases)
    return count


def test_no_function_says_more_than_one_thing():
    larger = set()
    for file, (text, tree) in files().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                if size(node, text) > MOST_CODE or ways(node) > MOST_WAYS:
                    larger.add(f"{file}: {node.name}")
    assert larger - MARCHES == LARGER.keys(), "mend the new one, or strike the one that is mended"


@functools.cache
def asked() -> dict[tuple[str, str], set[str]]:
    """Views that the methods of each class ask for: the second argument of each `show(self, ...)` in them."""
    found: dict[tuple[str, str], set[str]] = {}
    for file, (_, tree) in files().items():
        for kind in ast.walk(tree):
            for node in ast.walk(kind) if isinstance(kind, ast.ClassDef) else ():
                if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "show":
                    found.setdefault((module_of(file), kind.name), set()).add(ast.literal_eval(node.args[1]))
    return found


def test_every_result_shows_itself():
    """A view for each method that only asks for one, and no view that nothing asks for."""
    kinds = set()
    ignored = {f"rcorefine.{name.removesuffix('.py').replace('/', '.')}" for name in collect_ignore}
    for info in pkgutil.walk_packages(rco.__path__, "rcorefine."):
        if not info.name.endswith(("conftest", "__main__")) and info.name not in ignored:
            module = importlib.import_module(info.name)
            kinds |= {one for one in vars(module).values() if inspect.isclass(one)}
    kinds = {kind for kind in kinds if kind.__module__.startswith("rcorefine.")}
    wanted = {
        (kind, what)
        for kind in kinds
        for base in kind.__mro__
        for what in asked().get((base.__module__, base.__name__), ())
    }
    extended = {base for kind in kinds for base in kind.__mro__[1:]}
    missing = []
    for kind, what in wanted:
        try:
            results._view(kind, what)
        except TypeError:
            if kind not in extended:  # else those that extend it have a view of their own
                missing.append(f"{kind.__name__}: {what}")
    assert missing == []
    assert len(wanted) > 40
    assert {f"{kind.__name__}: {what}" for kind, what in results._views.keys() - wanted} == set()


def test_an_option_that_does_not_exist_is_named():
    with pytest.raises(TypeError, match=r"Measurement\.plot\(\).*'colour'"):
        rco.Measurement([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 3.0], dt=0.1).plot(colour="red")


def test_one_of_each():
    """One Riccati equation, autoregressive model, whitening, smoother, covariance and damped descent."""
    only = {
        "solve_discrete_are(": {"engine/observer.py"},
        "lfilter(a, [1.0]": set(),
        "np.convolve(signal": {"inference/whitening.py"},
        "np.linalg.pinv(": {
            # of a map between states and outputs or modes, not of information
            "comparison/failure_map/frequency.py", "inference/assembly.py",
            "streaming/coefficients/descent.py", "streaming/coefficients/restart.py",
        },
        "solve_toeplitz(": set(),
        "damping *=": {"streaming/coefficients/descent.py"},  # its steps come from a filter, not from columns
        "damping = max(": {"gauss_newton.py"},
        "def autoregression": {"inference/autoregression.py"},
        "class Whitener": {"inference/whitening.py"},
        "def smooth(": {"engine/smoother.py"},
        "def linearized(structure": {"inference/linearized.py"},
        "def covariance(normal": {"inference/covariance.py"},
    }  # fmt: skip
    for what, where in only.items():
        found = {file for file, (text, _) in files().items() if what in text}
        assert found == where, f"{what} in {sorted(found)}"
