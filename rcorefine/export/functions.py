"""A law's Python formula in another language, read from its source."""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Callable
from typing import Any, NamedTuple

from ..exceptions import ModelError

_SAME = frozenset("tanh exp sqrt sin cos tan sinh cosh asin acos atan atan2 log log10 floor".split())
_BUILT_IN = frozenset(("abs", "max", "min", "float"))
_SIGNS: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_COMPARED: dict[type[ast.cmpop], str] = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "=="}


class Language(NamedTuple):
    """Syntax of the formulas in one language.

    Parts to be filled in are marked as `{...}`.
    """

    name: str
    head: str
    argument: str
    between: str
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
    power: str
    functions: dict[str, str]
    reserved: frozenset[str]


_C = Language(
    "C", "static double {name}({arguments})\n{{", "double {}", ", ", "    double {names};", "}}",
    "{name} = {value};", "return {value};",
    "if ({test}) {{", "}} else {{", "}}", "({test} ? {yes} : {no})", "!=", "&&", "||", "!", "pow({0}, {1})",
    {"abs": "fabs", "max": "fmax", "min": "fmin", **{name: name for name in (
        "fabs", "copysign", "expm1", "log1p", "hypot", "pow")}},
    frozenset("auto break case char const continue default do double else float for goto if int long return "
              "short signed sizeof static struct switch typedef union unsigned void while".split()),
)  # fmt: skip
_MATLAB = Language(
    "MATLAB", "function result = {name}({arguments})", "{}", ", ", "", "end", "{name} = {value};",
    "result = {value}; return;", "if {test}", "else", "end", "pick({test}, {yes}, {no})", "~=", "&&",
    "||", "~", "({0})^({1})",
    {"abs": "abs", "fabs": "abs", "max": "max", "min": "min", "expm1": "expm1", "log1p": "log1p",
     "hypot": "hypot", "copysign": "flip", "pow": "({0})^({1})"},
    frozenset("end function if else elseif for while switch case otherwise result pick flip".split()),
)  # fmt: skip
_MODELICA = Language(
    "Modelica", "function {name}\n{arguments}\n    output Real result;", "    input Real {};", "\n",
    "  protected\n    Real {names};", "end {name};", "{name} := {value};", "result := {value}; return;",
    "if {test} then", "else", "end if;", "(if {test} then {yes} else {no})", "<>", "and", "or", "not",
    "({0})^({1})",
    {"abs": "abs", "fabs": "abs", "max": "max", "min": "min", "pow": "({0})^({1})",
     "copysign": "(if {1} < 0.0 then -abs({0}) else abs({0}))", "hypot": "sqrt(({0})^2 + ({1})^2)"},
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
        return (bilinear_stiffness * fmax(0.0, d));
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
    """Translation of one formula; `language` is None for Python."""

    def __init__(self, language: str, label: str, names: dict[str, Any], pair: bool) -> None:
        self.name, self.label, self.names, self.pair = language, label, names, pair
        self.language = LANGUAGES.get(language, _C)
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
        used = [item for part in body for item in ast.walk(part) if isinstance(item, ast.Name)]
        stored = {item.id for item in used if isinstance(item.ctx, ast.Store)}
        self.local = stored | set(arguments)
        if self.name == "Python":
            lines = [f"def {name}({', '.join(arguments)}):"]
            lines += [f"    {line}" for item in body for line in ast.unparse(self._plain(item)).splitlines()]
            return "\n".join(lines)
        language = self.language
        changed = stored & set(arguments)
        if changed and self.name == "Modelica":
            raise self.refuse(f"{changed.pop()} = ...")
        given = language.between.join(language.argument.format(self._word(item)) for item in arguments)
        lines = [language.head.format(name=name, arguments=given)]
        own = sorted(stored - set(arguments))
        if own and language.declare:
            lines.append(language.declare.format(names=", ".join(map(self._word, own))))
        if self.name == "Modelica":
            lines.append("  algorithm")
        if self.name == "C":
            read = {item.id for item in used}
            lines += [f"    (void){self._word(item)};" for item in arguments if item not in read]
        lines += self.block(body)
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
        if node.id in self.local or node.id in _BUILT_IN:
            return node
        if isinstance(value, int | float):
            return ast.Constant(float(value))
        if value is math or getattr(value, "__name__", "") == "numpy":
            return ast.Name("math" if value is math else "np", ast.Load())
        raise self.refuse(node)

    def _word(self, name: str) -> str:
        return f"{name}_" if name in self.language.reserved else name

    def block(self, body: list[ast.stmt]) -> list[str]:
        return [f"    {line}" for item in body for line in self.statement(item)]

    def statement(self, node: ast.stmt) -> list[str]:
        language = self.language
        match node:
            case ast.Return(value=ast.expr() as value):
                first = value.elts[0] if self.pair and isinstance(value, ast.Tuple) else value
                return [language.give.format(value=self.expression(first))]
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                return [language.assign.format(name=self._word(name), value=self.expression(value))]
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values) as value):
                used = {item.id for item in ast.walk(value) if isinstance(item, ast.Name)}
                if used & {getattr(item, "id", "") for item in targets}:
                    raise self.refuse(node)
                pairs = zip(targets, values, strict=True)
                return [line for t, v in pairs for line in self.statement(ast.Assign([t], v))]
            case ast.AugAssign(target=ast.Name(id=name), op=op, value=value):
                whole = ast.BinOp(ast.Name(name, ast.Load()), op, value)
                return [language.assign.format(name=self._word(name), value=self.expression(whole))]
            case ast.If(test=test, body=body, orelse=other):
                lines = [language.begin_if.format(test=self.expression(test)), *self.block(body)]
                lines += [language.other.format(), *self.block(other)] if other else []
                return [*lines, language.end_if.format()]
        raise self.refuse(node)

    def expression(self, node: ast.expr) -> str:
        language = self.language
        match node:
            case ast.Constant(value=int() | float() as value):
                return repr(float(value))
            case ast.Name():
                known = self._known(node)
                return self.expression(known) if isinstance(known, ast.Constant) else self._word(node.id)
            case ast.Attribute(attr=name) if isinstance(getattr(math, name, None), float):
                return repr(getattr(math, name))
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() | ast.Not() as op, operand=operand):
                sign = {ast.USub: "-", ast.UAdd: "+", ast.Not: f"{language.no} "}[type(op)]
                return f"({sign}{self.expression(operand)})"
            case ast.BinOp(op=ast.Pow(), left=left, right=right):
                whole = isinstance(right, ast.Constant) and isinstance(right.value, int)
                return language.power.format(
                    self.expression(left), ast.unparse(right) if whole else self.expression(right)
                )
            case ast.BinOp(op=op) if type(op) in _SIGNS:
                return f"({self.expression(node.left)} {_SIGNS[type(op)]} {self.expression(node.right)})"
            case ast.BoolOp(op=op, values=values):
                word = language.both if isinstance(op, ast.And) else language.either
                return "(" + f" {word} ".join(map(self.expression, values)) + ")"
            case ast.Compare(left=left, ops=ops, comparators=others):
                signs = _COMPARED | {ast.NotEq: language.unequal}
                if any(type(op) not in signs for op in ops):
                    raise self.refuse(node)
                terms = [self.expression(item) for item in (left, *others)]
                parts = [f"{terms[i]} {signs[type(op)]} {terms[i + 1]}" for i, op in enumerate(ops)]
                return "(" + f" {language.both} ".join(parts) + ")"
            case ast.IfExp(test=test, body=yes, orelse=no):
                parts = [self.expression(item) for item in (test, yes, no)]
                return language.choose.format(test=parts[0], yes=parts[1], no=parts[2])
            case ast.Call(func=ast.Name() | ast.Attribute(), keywords=[]):
                return self._call(node)
        raise self.refuse(node)

    def _call(self, node: ast.Call) -> str:
        called = node.func
        name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
        if isinstance(called, ast.Attribute):
            if isinstance(called.value, ast.Name):
                self._known(called.value)
        elif name not in _BUILT_IN and (
            name not in self.names or self.names[name] is not getattr(math, name, None)
        ):
            raise self.refuse(node)
        given = [self.expression(item) for item in node.args]
        if name == "float":
            return given[0]
        word = self.language.functions.get(name, name if name in _SAME else None)
        if word is None:
            raise self.refuse(node)
        if "{" in word:
            return word.format(*given)
        while len(given) > 2:  # of max and min
            given = [f"{word}({given[0]}, {given[1]})", *given[2:]]
        return f"{word}({', '.join(given)})"
