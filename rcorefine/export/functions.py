"""A law's Python formula in another language, read from its source."""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..exceptions import ModelError

__all__ = ["LANGUAGES", "Language", "translated"]

_SAME = frozenset("tanh exp sqrt sin cos tan sinh cosh asin acos atan atan2 log log10 floor".split())
_POWER = {"C": "pow({0}, {1})", "Python": "{0} ** {1}"}


@dataclass(frozen=True, slots=True)
class Language:
    """Syntax of the formulas in one language.

    Parts to be filled in are marked as `{...}`.
    """

    name: str
    head: str
    declare: str
    end: str
    assign: str
    give: str
    begin_if: str
    other: str
    end_if: str
    choose: str
    unequal: str
    both: str
    either: str
    no: str
    functions: dict[str, str]
    reserved: frozenset[str] = frozenset()


_C = Language(
    "C", "static double {name}({arguments})\n{{", "    double {names};", "}}", "{name} = {value};",
    "return {value};",
    "if ({test}) {{", "}} else {{", "}}", "({test} ? {yes} : {no})", "!=", "&&", "||", "!",
    {"abs": "fabs", "fabs": "fabs", "max": "fmax", "min": "fmin", "copysign": "copysign", "expm1": "expm1",
     "log1p": "log1p", "hypot": "hypot"},
    frozenset("auto break case char const continue default do double else float for goto if int long return "
              "short signed sizeof static struct switch typedef union unsigned void while".split()),
)  # fmt: skip
_MATLAB = Language(
    "MATLAB", "function result = {name}({arguments})", "", "end", "{name} = {value};",
    "result = {value}; return;", "if {test}", "else", "end", "pick({test}, {yes}, {no})", "~=", "&&",
    "||", "~",
    {"abs": "abs", "fabs": "abs", "max": "max", "min": "min", "expm1": "expm1", "log1p": "log1p",
     "hypot": "hypot", "copysign": "flip"},
    frozenset("end function if else elseif for while switch case otherwise result pick flip".split()),
)  # fmt: skip
_MODELICA = Language(
    "Modelica", "function {name}\n{arguments}\n    output Real result;", "  protected\n    Real {names};",
    "end {name};", "{name} := {value};", "result := {value}; return;",
    "if {test} then", "else", "end if;", "(if {test} then {yes} else {no})", "<>", "and", "or", "not",
    {"abs": "abs", "fabs": "abs", "max": "max", "min": "min"},
    frozenset("and or not if then else end loop for while when der model function input output equation "
              "algorithm time result initial flow final within".split()),
)  # fmt: skip
LANGUAGES = {language.name: language for language in (_C, _MATLAB, _MODELICA)}


def translated(function: Callable[..., Any], name: str, language: str, label: str, pair: bool = False) -> str:
    """A formula as a function of another language.

    Parameters
    ----------
    function : callable
        Formula, written for scalars: assignments, `if`, arithmetic, functions of `math`.
    name : str
        What the function is called.
    language : {"Python", "C", "MATLAB", "Modelica"}
        Language.
    label : str
        The effect, for messages.
    pair : bool
        Whether the formula returns its inner state behind the force: left out.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If the source is not there, or holds what the language has no words for here.

    Examples
    --------
    >>> from rcorefine.effects.law import KINDS
    >>> print(translated(KINDS["bilinear_stiffness"].law, "law1", "C", "a kink"))
    static double law1(double d, double bilinear_stiffness)
    {
        return (bilinear_stiffness * fmax(d, 0.0));
    }
    """
    plain = getattr(function, "py_func", function)
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(plain)))
        definition = next(node for node in tree.body if isinstance(node, ast.FunctionDef))
    except (OSError, TypeError, SyntaxError, StopIteration, IndentationError) as error:
        raise ModelError(
            f"{label}: the source of its law is not to be had, so it cannot be written in {language}; define "
            "it by `def` in a file"
        ) from error
    scope = inspect.getclosurevars(plain)
    names = {**scope.globals, **scope.nonlocals}
    return _Writer(language, label, names, pair).function(definition, name)


class _Writer:
    def __init__(self, language: str, label: str, names: dict[str, Any], pair: bool) -> None:
        self.name, self.label, self.names, self.pair = language, label, names, pair
        self.language = LANGUAGES.get(language)
        self.local: set[str] = set()

    def refuse(self, what: ast.AST | str) -> ModelError:
        text = what if isinstance(what, str) else ast.unparse(what)
        return ModelError(f"{self.label}: its law holds {text!r}, which is not written in {self.name} here")

    def function(self, node: ast.FunctionDef, name: str) -> str:
        arguments = [item.arg for item in node.args.args]
        body = [
            item
            for item in node.body
            if not (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant))
        ]
        inner = ast.walk(ast.Module(body, []))
        stored = {item.id for item in inner if isinstance(item, ast.Name) and isinstance(item.ctx, ast.Store)}
        self.local = stored | set(arguments)
        language = self.language
        if language is None:
            lines = [f"def {name}({', '.join(arguments)}):"]
            lines += [f"    {line}" for item in body for line in ast.unparse(self._plain(item)).splitlines()]
            return "\n".join(lines)
        written = [self._word(item) for item in arguments]
        if language.name == "Modelica":
            given = "\n".join(f"    input Real {item};" for item in written)
        else:
            given = ", ".join(f"double {item}" if language.name == "C" else item for item in written)
        lines = [language.head.format(name=name, arguments=given)]
        own = sorted(stored - set(arguments))
        changed = stored & set(arguments)
        if changed and language.name == "Modelica":
            raise self.refuse(f"{changed.pop()} = ...")
        if own and language.declare:
            lines.append(language.declare.format(names=", ".join(map(self._word, own))))
        if language.name == "Modelica":
            lines.append("  algorithm")
        if language.name == "C":
            read = {item.id for part in body for item in ast.walk(part) if isinstance(item, ast.Name)}
            lines += [f"    (void){self._word(item)};" for item in arguments if item not in read]
        for item in body:
            lines += [f"    {line}" for line in self.statement(item)]
        return "\n".join([*lines, language.end.format(name=name)])

    def _plain(self, node: ast.stmt) -> ast.stmt:
        """Return a Python statement with values in place of names.

        Only names of the module are replaced. Of a pair of returned values, the force alone is kept.
        """
        outer = self

        class Inline(ast.NodeTransformer):
            def visit_Name(self, item: ast.Name) -> ast.AST:
                return ast.copy_location(outer._known(item), item)

            def visit_Return(self, item: ast.Return) -> ast.AST:
                self.generic_visit(item)
                if outer.pair and isinstance(item.value, ast.Tuple):
                    item.value = item.value.elts[0]
                return item

        found: ast.stmt = ast.fix_missing_locations(Inline().visit(node))
        return found

    def _known(self, node: ast.Name) -> ast.expr:
        value = self.names.get(node.id)
        if node.id in self.local or node.id in ("abs", "max", "min", "float"):
            return node
        if isinstance(value, int | float):
            return ast.Constant(float(value))
        if value is math or getattr(value, "__name__", "") == "numpy":
            return ast.Name("math" if value is math else "np", ast.Load())
        raise self.refuse(node)

    def _word(self, name: str) -> str:
        assert self.language is not None
        return f"{name}_" if name in self.language.reserved else name

    def statement(self, node: ast.stmt) -> list[str]:
        language = self.language
        assert language is not None
        if isinstance(node, ast.Return) and node.value is not None:
            value = node.value.elts[0] if self.pair and isinstance(node.value, ast.Tuple) else node.value
            return [language.give.format(value=self.expression(value))]
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value = node.targets[0], node.value
            if isinstance(target, ast.Name):
                return [language.assign.format(name=self._word(target.id), value=self.expression(value))]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                used = {item.id for item in ast.walk(value) if isinstance(item, ast.Name)}
                if not used & {getattr(item, "id", "") for item in target.elts}:
                    pairs = zip(target.elts, value.elts, strict=True)
                    return [line for t, v in pairs for line in self.statement(ast.Assign([t], v))]
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
            whole = ast.BinOp(ast.Name(node.target.id, ast.Load()), node.op, node.value)
            return [language.assign.format(name=self._word(node.target.id), value=self.expression(whole))]
        if isinstance(node, ast.If):
            lines = [language.begin_if.format(test=self.expression(node.test))]
            lines += [f"    {line}" for item in node.body for line in self.statement(item)]
            if node.orelse:
                lines.append(language.other.format())
                lines += [f"    {line}" for item in node.orelse for line in self.statement(item)]
            return [*lines, language.end_if.format()]
        raise self.refuse(node)

    def expression(self, node: ast.expr) -> str:
        language = self.language
        assert language is not None
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return repr(float(node.value))
        if isinstance(node, ast.Name):
            known = self._known(node)
            return self.expression(known) if isinstance(known, ast.Constant) else self._word(node.id)
        if isinstance(node, ast.Attribute) and isinstance(getattr(math, node.attr, None), float):
            return repr(getattr(math, node.attr))
        if isinstance(node, ast.UnaryOp):
            sign = {ast.USub: "-", ast.UAdd: "+", ast.Not: f"{language.no} "}.get(type(node.op))
            if sign is not None:
                return f"({sign}{self.expression(node.operand)})"
        if isinstance(node, ast.BinOp):
            return self._binary(node)
        if isinstance(node, ast.BoolOp):
            word = language.both if isinstance(node.op, ast.And) else language.either
            return "(" + f" {word} ".join(map(self.expression, node.values)) + ")"
        if isinstance(node, ast.Compare):
            return self._compare(node)
        if isinstance(node, ast.IfExp):
            parts = {"test": node.test, "yes": node.body, "no": node.orelse}
            return language.choose.format(**{key: self.expression(part) for key, part in parts.items()})
        if isinstance(node, ast.Call) and not node.keywords:
            return self._call(node)
        raise self.refuse(node)

    def _binary(self, node: ast.BinOp) -> str:
        left, right = self.expression(node.left), self.expression(node.right)
        if isinstance(node.op, ast.Pow):
            if isinstance(node.right, ast.Constant) and isinstance(node.right.value, int):
                right = str(node.right.value)
            return _POWER.get(self.name, "({0})^({1})").format(left, right)
        sign = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}.get(type(node.op))
        if sign is None:
            raise self.refuse(node)
        return f"({left} {sign} {right})"

    def _compare(self, node: ast.Compare) -> str:
        assert self.language is not None
        signs = {
            ast.Lt: "<",
            ast.LtE: "<=",
            ast.Gt: ">",
            ast.GtE: ">=",
            ast.Eq: "==",
            ast.NotEq: self.language.unequal,
        }
        parts, left = [], node.left
        for op, right in zip(node.ops, node.comparators, strict=True):
            if type(op) not in signs:
                raise self.refuse(node)
            parts.append(f"{self.expression(left)} {signs[type(op)]} {self.expression(right)}")
            left = right
        return "(" + f" {self.language.both} ".join(parts) + ")"

    def _call(self, node: ast.Call) -> str:
        assert self.language is not None
        called = node.func
        name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
        if isinstance(called, ast.Name) and name not in ("abs", "max", "min", "float"):
            if getattr(math, name, None) is not self.names.get(name) or name not in self.names:
                raise self.refuse(node)
        elif isinstance(called, ast.Attribute):
            self._known(called.value) if isinstance(called.value, ast.Name) else None
        given = [self.expression(item) for item in node.args]
        if name == "float":
            return given[0]
        if name == "pow":
            return _POWER.get(self.name, "({0})^({1})").format(*given)
        if name == "copysign" and self.name == "Modelica":
            return f"(if {given[1]} < 0.0 then -abs({given[0]}) else abs({given[0]}))"
        if name == "hypot" and self.name == "Modelica":
            return f"sqrt(({given[0]})^2 + ({given[1]})^2)"
        word = name if name in _SAME else self.language.functions.get(name)
        if word is None:
            raise self.refuse(node)
        while len(given) > 2:  # of max and min
            given = [f"{word}({given[0]}, {given[1]})", *given[2:]]
        return f"{word}({', '.join(given)})"
