"""The layout of the package: imports run down one list, nobody imports pictures, results show themselves."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import io
import pkgutil
import re
import textwrap
import tokenize
from collections import Counter
from pathlib import Path

import pytest
from inner import KINDS
from radon.complexity import cc_visit

import rcorefine as rco
from rcorefine import results
from rcorefine.conftest import collect_ignore
from rcorefine.views.content import content

PACKAGE = Path(rco.__file__).parent
#: Each may import those before it, and none after it.
ORDER = (
    "version", "exceptions", "jit", "arguments", "progress", "writing", "results", "systems", "gauss_newton",
    "data", "effects", "models", "engine", "export", "inference", "comparison", "refinement", "diagnosis",
    "localization", "fleet", "streaming", "examples", "exercises", "views", "explorer", "commands",
    "__main__",
)  # fmt: skip


#: Rooms that stand on the public names, and the inner names that each still takes. They may only get fewer.
OUTER = {
    "exercises": set(),
    "export": set(),
    "fleet": set(),
    "explorer": {"refinement.by_hand"},
    "commands": set(),
}  # fmt: skip
#: Tokens of code (no docstring, comment, line end) of each top-level folder, and of the files beside them.
#: A commit may lower a figure; one that raises it says in its message what went out in exchange.
BUDGET = {
    ".": 8148, "arguments": 2154, "commands": 8142, "comparison": 28302, "data": 26220,
    "diagnosis": 74091, "effects": 30851, "engine": 50565, "examples": 2218, "exercises": 4771,
    "explorer": 9112, "export": 5906, "fleet": 9881, "inference": 34458, "localization": 11828,
    "models": 42870, "refinement": 4354, "streaming": 55439, "systems": 5887, "views": 39625,
}  # fmt: skip
#: Functions of a radon complexity above 15, functions that take more than 8 parameters (private ones and
#: kernels), private functions of fewer than 6 lines of code that one place calls: not more than there are.
COMPLEX, WIDE, TINY = 15, 0, 78


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
        if module != "rcorefine"
        and (part(module) not in OUTER if other == "rcorefine" else place[part(module)] < place[part(other)])
    ]
    assert up == []


def test_outer_rooms_stand_on_the_public_names():
    """They show how far the public names reach: `rcorefine` itself, and what no analysis is in."""
    base = {"", *ORDER[: ORDER.index("systems")]}
    inner = {
        room: {
            other.removeprefix("rcorefine.")
            for module, others in imports().items()
            for other in others
            if part(module) == room and part(other) not in base | {room}
        }
        for room in OUTER
    }
    assert {room: sorted(names - OUTER[room]) for room, names in inner.items() if names - OUTER[room]} == {}
    assert {room: sorted(OUTER[room] - names) for room, names in inner.items() if OUTER[room] - names} == {}


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
        
        "fleet/tasks.py", "models/physical_model.py", "streaming/coefficients/entries.py",
        "views/diagnosis.py", "views/models.py", "views/reports.py", "views/streaming.py",
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


def test_first_lines_of_docstrings_are_short_and_plain():
    """At most 72 characters; what a function returns, or what it does, not a question."""
    wrong = []
    for file, (_, tree) in files().items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                continue
            first = (ast.get_docstring(node) or "").split("\n")[0]
            if len(first) > 72 or re.match(r"(What|Whether|Where|Why|How|The same)\b", first):
                wrong.append(f"{file}: {first}")
    assert wrong == []


#: House words that nobody outside reads at once (shared list of plain words). Names of fields are no prose.
BANNED = re.compile(
    r"\b(outweighs?|outdone|races?|battery|ladders?|rungs?|climbs?|led by an observer|noise with a memory"
    r"|tells? (it )?apart|tells? it from|laws? (is|are|stays) open|certain word|comes? home|numbers? floats?"
    r"|took part in nothing|further off|beside numbers|moved numbers|every rival|(two|all|these) rivals)\b",
    re.IGNORECASE,
)
#: An RC ladder is a circuit; a script and a picture have their names.
FIELD = re.compile(r"LC ladder|ladders\.py|race\.png")


def test_no_text_uses_house_words():
    found = []
    for file, (_, tree) in files().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
                text = FIELD.sub("", node.value)
                found += [f"{file}:{node.lineno} {m.group()}" for m in BANNED.finditer(text)]
    root = PACKAGE.parent
    docs = root / "docs"  # without the pages that the site makes of notebooks and docstrings
    for page in [*root.glob("*.md"), *docs.glob("*.md"), *docs.glob("coursework/*.md")]:
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
            found += [f"{page.name}:{number} {m.group()}" for m in BANNED.finditer(FIELD.sub("", line))]
    assert found == []


_SILENT = frozenset({
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
})  # fmt: skip


def code_tokens(node: ast.AST, text: str) -> list[tokenize.TokenInfo]:
    """Tokens of code of a module or function: no docstring, no comment, no line end."""
    first = getattr(node, "lineno", 1)
    source = "\n".join(text.split("\n")[first - 1 : getattr(node, "end_lineno", None)])
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    prose: set[int] = set()
    for inner in ast.walk(node):
        if isinstance(inner, documented) and ast.get_docstring(inner, clean=False) is not None:
            prose |= set(range(inner.body[0].lineno - first + 1, inner.body[0].end_lineno - first + 2))
    tokens = tokenize.generate_tokens(io.StringIO(textwrap.dedent(source)).readline)
    return [token for token in tokens if token.type not in _SILENT and token.start[0] not in prose]


def functions() -> list[tuple[str, ast.FunctionDef, str]]:
    """File, tree and text of each function of the package."""
    return [
        (file, node, text)
        for file, (text, tree) in files().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    ]


def test_no_folder_holds_more_code_than_its_budget():
    counted: Counter[str] = Counter()
    for file, (text, tree) in files().items():
        counted[file.split("/")[0] if "/" in file else "."] += len(code_tokens(tree, text))
    over = {
        folder: f"{n} > {BUDGET.get(folder, 0)}" for folder, n in counted.items() if n > BUDGET.get(folder, 0)
    }
    assert over == {}
    loose = {
        folder: f"{counted[folder]} < {n} - 500" for folder, n in BUDGET.items() if counted[folder] < n - 500
    }
    assert loose == {}, "lower the budget to what is there"


def test_no_two_classes_have_the_same_name():
    """A name that means two things in one package is looked up in the wrong file."""
    places: dict[str, list[str]] = {}
    for file, (_, tree) in files().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(file)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_no_more_complex_functions():
    found = [
        f"{file}: {block.name} {block.complexity}"
        for file, (text, _) in files().items()
        for block in cc_visit(text)
        if block.complexity > 15 and block.letter in "FM"
    ]
    assert len(found) <= COMPLEX, "\n".join(found)


def test_no_more_wide_functions():
    """More than 8 parameters: settings travel in a NamedTuple."""
    found = []
    for file, node, _ in functions():
        arguments = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
        compiled = any("njit" in ast.unparse(one) for one in node.decorator_list)
        # a constructor is public: its arguments are those that users give
        private = node.name.startswith("_") and node.name != "__init__"
        if len(arguments) > 8 and (private or compiled):
            found.append(f"{file}: {node.name} {len(arguments)}")
    assert len(found) <= WIDE, "\n".join(found)


def test_no_more_tiny_helpers():
    """A private function of fewer than 6 lines of code that one place in its file calls is a detour."""
    found = []
    for file, (text, tree) in files().items():
        names = Counter(
            getattr(node, "id", getattr(node, "attr", ""))
            for node in ast.walk(tree)
            if isinstance(node, (ast.Name, ast.Attribute))
        )
        for node in ast.walk(tree):
            private = isinstance(node, ast.FunctionDef) and re.match(r"_[^_]", node.name)
            if (
                private
                and names[node.name] == 1
                and len({token.start[0] for token in code_tokens(node, text)}) < 6
            ):
                found.append(f"{file}: {node.name}")
    assert len(found) <= TINY, "\n".join(found)


@functools.cache
def asked() -> dict[tuple[str, str], set[str]]:
    """Pictures that the methods of each class ask for: the second argument of `show(self, ...)`."""
    found: dict[tuple[str, str], set[str]] = {}
    for file, (_, tree) in files().items():
        for kind in ast.walk(tree):
            for node in ast.walk(kind) if isinstance(kind, ast.ClassDef) else ():
                if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "show":
                    found.setdefault((module_of(file), kind.name), set()).add(ast.literal_eval(node.args[1]))
    return found


def test_callers_ask_a_record_and_do_not_look_at_its_class():
    """A record in time and a frequency response answer alike; `data/` alone knows which is which."""
    kinds = re.compile(r"in_frequency\(|isinstance\([^)]*ResponseRecord")
    assert [file for file, (text, _) in files().items() if kinds.search(text) and "data/" not in file] == []


def test_every_result_shows_itself():
    """A content for each class of results, with the pictures that its methods ask for, and no others."""
    kinds = set()
    ignored = {f"rcorefine.{name.removesuffix('.py').replace('/', '.')}" for name in collect_ignore}
    for info in pkgutil.walk_packages(rco.__path__, "rcorefine."):
        if not info.name.endswith(("conftest", "__main__")) and info.name not in ignored:
            module = importlib.import_module(info.name)
            kinds |= {one for one in vars(module).values() if inspect.isclass(one)}
    kinds = {kind for kind in kinds if kind.__module__.startswith("rcorefine.")}
    wanted = {
        kind: {what for base in kind.__mro__ for what in asked().get((base.__module__, base.__name__), ())}
        for kind in kinds
    }
    extended = {base for kind in kinds for base in kind.__mro__[1:]}
    shown = {kind for kind in kinds if wanted[kind] or issubclass(kind, results.Result)} - extended
    without = content.dispatch(object)
    assert {kind.__name__ for kind in shown if content.dispatch(kind) is without} == set()
    assert len(shown) > 18
    for kind, make in content.registry.items():
        if make is not without:  # its pictures by name
            drawn = set(re.findall(r'"(\w+)": plot_', inspect.getsource(make)))
            assert drawn == wanted[kind], kind.__name__


@pytest.mark.parametrize("tier", ["slow", "oracles", "slow_in_plain_python"])
def test_lists_of_tests_name_tests_that_exist(tier):
    """A line is a test or one of its cases; a test that was renamed would change its tier unseen."""
    root = PACKAGE.parent
    lost = []
    for line in (root / "tests" / f"{tier}.txt").read_text(encoding="utf-8").splitlines():
        file, *names = line.split("[")[0].split("::")
        if not (root / file).exists() or (
            file.startswith("tests/") and f"def {names[-1]}(" not in (root / file).read_text(encoding="utf-8")
        ):
            lost.append(line)
    assert lost == []


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
            "streaming/families.py", "streaming/filter.py",
        },
        "solve_toeplitz(": set(),
        "damping *=": set(),
        "damping = max(": {"gauss_newton.py"},
        "def autoregression": {"inference/whitening.py"},
        "class Whitener": {"inference/whitening.py"},
        "def smooth(": {"engine/smoother.py"},
        "def linearized(structure": {"engine/point.py"},
        "def covariance(normal": {"inference/covariance.py"},
    }  # fmt: skip
    for what, where in only.items():
        found = {file for file, (text, _) in files().items() if what in text}
        assert found == where, f"{what} in {sorted(found)}"


# ------------------------------------------------------------------ tests that hold nothing
VERDICTS = {"adequate", "parameters", "effect", "ambiguous", "unexplained"}
#: A command that is interrupted, or given a random label, may end in several ways.
SEVERAL_ENDS = {"test_interruptions.py", "test_labels.py"}


@functools.cache
def trees() -> dict[str, ast.Module]:
    """Syntax tree of each file of the tests."""
    return {
        path.name: ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted((PACKAGE.parent / "tests").rglob("*.py"))
    }


def compared_with_several(tree: ast.AST) -> list[tuple[int, set[object]]]:
    """Lines that assert that something is one of several constants, and these."""
    found = []
    for node in ast.walk(tree):
        for inner in ast.walk(node.test) if isinstance(node, ast.Assert) else ():
            if isinstance(inner, ast.Compare) and isinstance(inner.ops[0], ast.In):
                several = inner.comparators[0]
                if isinstance(several, ast.Tuple | ast.List | ast.Set):
                    values = {one.value for one in several.elts if isinstance(one, ast.Constant)}
                    found.append((inner.lineno, values))
    return found


def test_no_expected_failure_may_pass():
    """An xfail that passes is an error: `xfail_strict` of pyproject.toml, and no mark that overrides it."""
    assert "xfail_strict = true" in (PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8")
    loose = [
        f"{file}:{node.lineno}"
        for file, tree in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("xfail")
        if any(word.arg == "strict" and ast.unparse(word.value) != "True" for word in node.keywords)
    ]
    assert loose == []


def test_no_assertion_accepts_several_verdicts():
    """`named` of tests/cases.py asserts the coefficient as well; else a test knows the word."""
    several = [
        f"{file}:{line}"
        for file, tree in trees().items()
        for line, values in compared_with_several(tree)
        if len(values & VERDICTS) > 1 and file != "cases.py"
    ]
    assert several == []


def test_no_assertion_accepts_success_or_failure():
    """A test knows how its command ends: 0, or 1 where something was found."""
    either = [
        f"{file}:{line}"
        for file, tree in trees().items()
        for line, values in compared_with_several(tree)
        if {0, 1} <= values and file not in SEVERAL_ENDS
    ]
    assert either == []
