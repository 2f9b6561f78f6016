"""The layout of the package: imports run down one list, nobody imports pictures, results show themselves."""

from __future__ import annotations

import ast
import functools
import importlib
import pkgutil
import sys
from pathlib import Path

import pytest

import rcorefine as rco
from rcorefine import results
from rcorefine.effects.law import KINDS

PACKAGE = Path(rco.__file__).parent
#: Each may import those before it, and none after it.
ORDER = (
    "version", "exceptions", "arithmetic", "jit", "arguments", "progress", "writing", "archives", "results",
    "systems", "gauss_newton", "data", "effects", "models", "engine", "export", "inference", "comparison",
    "refinement",
    "diagnosis", "localization", "streaming", "examples", "views", "commands", "__main__",
)  # fmt: skip


#: A file holds one idea: at most so many lines.
MOST_LINES = 350
#: Files that are longer, and why.
LONGER = {
    "effects/effect.py": "the public class of an effect, with its arguments",
    "effects/law.py": "the base class that a user's law derives from, and its coefficients",
    "engine/kernels.py": "the march: one compiled loop",
    "engine/structure.py": "the matrices of a model in feedback with effects",
    "streaming/rcmr/kernels.py": "the paper's equations, compiled",
    "streaming/refiner.py": "one public class: most of it says what its arguments and results are",
}


@functools.cache
def imports() -> dict[str, set[str]]:
    """Modules of the package that each module imports, inside functions too; not what is for types only."""
    files = {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in PACKAGE.rglob("*.py")
        if path.name != "conftest.py"
    }
    found: dict[str, set[str]] = {}
    for module, path in files.items():
        tree = ast.parse(path.read_text())
        typing = {
            id(inner)
            for node in ast.walk(tree)
            if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
            for inner in ast.walk(node)
        }
        parents = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
        found[module] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                found[module] |= {name.name for name in node.names} & files.keys()
            elif isinstance(node, ast.ImportFrom) and id(node) not in typing:
                above = parents[: len(parents) + 1 - node.level] if node.level else []
                base = ".".join([*above, *([node.module] if node.module else [])])
                for name in node.names:
                    inner = f"{base}.{name.name}"
                    found[module] |= {inner if inner in files else base} & files.keys() - {module}
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


def test_nobody_imports_views_but_the_face_and_the_commands():
    asked = {
        part(module) for module, others in imports().items() for other in others if part(other) == "views"
    }
    assert asked <= {"", "views", "commands"}


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
        "diagnosis/stepwise/backward.py", "diagnosis/stepwise/selection.py", "models/physical_model.py",
        "streaming/coefficients/entries.py", "views/diagnosis.py", "views/experiment.py",
        "views/improvement.py", "views/monitor.py", "views/pages/diagnosis.py",
    },
    "damping": {"localization/localize.py"},
    "mass": {"models/detection.py"},
}  # fmt: skip


def test_no_kind_of_effect_is_named_where_laws_do_not_live():
    """Others ask a law for its attributes, or import its class: a new law needs no other file."""
    free = ("effects/", "models/builders/", "examples/", "commands/")
    named = []
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE).as_posix()
        if file.startswith(free):
            continue
        words = [
            node.value
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in KINDS
        ]
        meant = [word for word in set(words) if file in _HOMONYMS.get(word, ())]
        for word in meant:  # once each
            words.remove(word)
        named += [f"{file}: {word}" for word in words]
    assert named == []


def test_no_file_is_longer_than_one_idea():
    lengths = {
        path.relative_to(PACKAGE).as_posix(): path.read_text().count("\n") for path in PACKAGE.rglob("*.py")
    }
    assert {name: n for name, n in lengths.items() if n > MOST_LINES and name not in LONGER} == {}
    assert LONGER.keys() <= lengths.keys()


def test_every_result_shows_itself():
    """Text and HTML for each class that says so, and a view for each method that only asks for one."""
    for info in pkgutil.walk_packages(rco.__path__, "rcorefine."):
        if not info.name.endswith(("conftest", "__main__")):
            importlib.import_module(info.name)
    pending, kinds = [results.Result], []
    while pending:
        new = pending.pop().__subclasses__()
        pending += new
        # a dataclass with slots is made twice; the first one waits for the garbage collector
        kinds += [kind for kind in new if getattr(sys.modules[kind.__module__], kind.__name__) is kind]
    kinds = [kind for kind in kinds if kind.__module__ != results.__name__]
    assert len(kinds) > 10
    for kind in kinds:
        asked = ((name, getattr(kind, name, None)) for name in ("plot", "bode_plot", "report"))
        methods = [
            name for name, method in asked if getattr(method, "__module__", "").startswith("rcorefine")
        ]
        for what in ("text", "html", *methods):
            assert callable(results._view(kind, what)), f"{kind.__name__} has no view {what!r}"


def test_an_option_that_does_not_exist_is_named():
    with pytest.raises(TypeError, match=r"Measurement\.plot\(\).*'colour'"):
        rco.Measurement([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 2.0, 3.0], dt=0.1).plot(colour="red")


def test_one_of_each():
    """One Riccati equation, autoregressive model, whitening, smoother, covariance and damped descent."""
    only = {
        "solve_discrete_are(": {"engine/observer.py"},
        "lfilter(a, [1.0]": {"inference/whitening.py"},
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
    sources = {str(path.relative_to(PACKAGE)): path.read_text() for path in PACKAGE.rglob("*.py")}
    for what, where in only.items():
        found = {name for name, text in sources.items() if what in text}
        assert found == where, f"{what} in {sorted(found)}"
