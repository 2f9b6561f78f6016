"""A law's Python formula in another language, read from its source."""

from __future__ import annotations

import ast
import inspect
import math
import re
import textwrap
from collections.abc import Callable, Container, Iterable
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

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
    unused: str = ""  #: line that mentions an argument which the formula does not read


_C = Language(
    "C", "static double {name}({arguments})\n{{", "double {}", ", ", "    double {names};", "}}",
    "{name} = {value};", "return {value};",
    "if ({test}) {{", "}} else {{", "}}", "({test} ? {yes} : {no})", "!=", "&&", "||", "!", "pow({0}, {1})",
    {"abs": "fabs", "max": "fmax", "min": "fmin", **{name: name for name in (
        "fabs", "copysign", "expm1", "log1p", "hypot", "pow")}},
    frozenset("alignas alignof asm auto bool break case char const constexpr continue default do double "
              "else enum extern false float for goto if inline int linux long nullptr register restrict "
              "return short signed sizeof static static_assert struct switch thread_local true typedef "
              "typeof typeof_unqual union unix unsigned void volatile while HUGE_VAL HUGE_VALF "
              "HUGE_VALL INFINITY MATH_ERREXCEPT MATH_ERRNO NAN math_errhandling".split()),
    unused="    (void){};",
)  # fmt: skip
_MATLAB = Language(
    "MATLAB", "function result = {name}({arguments})", "{}", ", ", "", "end", "{name} = {value};",
    "result = {value}; return;", "if {test}", "else", "end", "pick({test}, {yes}, {no})", "~=", "&&",
    "||", "~", "({0})^({1})",
    {"abs": "abs", "fabs": "abs", "max": "max", "min": "min", "expm1": "expm1", "log1p": "log1p",
     "hypot": "hypot", "copysign": "flip", "pow": "({0})^({1})"},
    frozenset("break case catch classdef continue do else elseif end endfunction endif endwhile for "
              "function global if otherwise parfor persistent pick flip result return spmd switch try "
              "until while".split()),
)  # fmt: skip
LANGUAGES = {language.name: language for language in (_C, _MATLAB)}


def word(name: str, language: str, taken: Iterable[str] = ()) -> str:
    """Return a name as another language may write it, none of those taken."""
    made = re.sub(r"[^A-Za-z0-9_]", lambda sign: f"u{ord(sign[0]):x}", name)
    made = made if made[0].isalpha() else f"v{made}"
    known = LANGUAGES[language]
    others = {*known.reserved, *known.functions, *known.functions.values(), *_SAME, *taken}
    while made in others or re.fullmatch(r"law\d+", made):
        made += "_"
    return made


def translated(
    function: Callable[..., Any],
    name: str,
    language: str,
    label: str,
    pair: bool = False,
    taken: Container[str] = (),
) -> str:
    """A formula as a function of another language.

    Parameters
    ----------
    function : callable
        Formula, written for scalars: assignments, `if`, arithmetic, functions of `math`.
    name : str
        What the function is called.
    language : {"Python", "C", "MATLAB"}
        Language.
    label : str
        The effect, for messages.
    pair : bool
        Whether the formula returns its inner state behind the force: left out.
    taken : container of str
        Arguments that are handed over even if they have a default; others keep it.

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
    static double law1(double d, double bilinear_stiffness, double side)
    {
        return ((bilinear_stiffness * side) * fmax(0.0, (side * d)));
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
    return _Writer(language, label, plain, pair).function(definition, name, taken)


class _Writer:
    """Translation of one formula; `language` is None for Python."""

    def __init__(self, language: str, label: str, plain: Callable[..., Any], pair: bool) -> None:
        scope = inspect.getclosurevars(plain)
        self.name, self.label, self.names, self.pair = (
            language,
            label,
            {**scope.globals, **scope.nonlocals},
            pair,
        )
        given = inspect.signature(plain).parameters.values()
        self.defaults = {one.name: one.default for one in given if one.default is not one.empty}
        self.language = LANGUAGES.get(language, _C)
        self.local: set[str] = set()
        self.words: dict[str, str] = {}

    def refuse(self, what: ast.AST | str) -> ModelError:
        text = what if isinstance(what, str) else ast.unparse(what)
        return ModelError(f"{self.label}: its law holds {text!r}, which is not written in {self.name} here")

    def _parts(self, node: ast.FunctionDef, taken: Container[str]) -> tuple[list[str], list[ast.stmt]]:
        """Return the arguments, and the statements behind kept defaults."""
        parameters = [item.arg for item in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
        arguments = [item for item in parameters if item in taken or item not in self.defaults]
        body = [
            item
            for item in node.body
            if not (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant))
        ]
        read = {item.id for part in body for item in ast.walk(part) if isinstance(item, ast.Name)}
        for item in parameters:
            if item in read and item not in arguments:  # it keeps its default
                if not isinstance(self.defaults[item], Real):
                    raise self.refuse(f"{item}={self.defaults[item]!r}")
                body = [*ast.parse(f"{item} = {float(self.defaults[item])!r}").body, *body]
        return arguments, body

    def function(self, node: ast.FunctionDef, name: str, taken: Container[str]) -> str:
        arguments, body = self._parts(node, taken)
        used = [item for part in body for item in ast.walk(part) if isinstance(item, ast.Name)]
        stored = {item.id for item in used if isinstance(item.ctx, ast.Store)}
        self.local = stored | set(arguments)
        if self.name == "Python":
            lines = [f"def {name}({', '.join(arguments)}):"]
            lines += [f"    {line}" for item in body for line in ast.unparse(self._plain(item)).splitlines()]
            return "\n".join(lines)
        for item in sorted(self.local):
            self.words[item] = word(item, self.name, self.words.values())
        head = self._head(name, arguments, stored, {item.id for item in used})
        return "\n".join([*head, *self.block(body), self.language.end.format(name=name)])

    def _head(self, name: str, arguments: list[str], stored: set[str], used: set[str]) -> list[str]:
        """Return the lines before the statements: arguments and variables."""
        language, words = self.language, self.words
        given = language.between.join(language.argument.format(words[item]) for item in arguments)
        lines = [language.head.format(name=name, arguments=given)]
        own = [words[item] for item in sorted(stored - set(arguments))]
        if own and language.declare:
            lines.append(language.declare.format(names=", ".join(own)))
        unread = [words[item] for item in arguments if item not in used and language.unused]
        return [*lines, *(language.unused.format(item) for item in unread)]

    def _plain(self, node: ast.stmt) -> ast.stmt:
        """Return a Python statement with values in place of names.

        Only names of the module are replaced. Of a pair of returned values, the force alone is kept.
        """
        outer = self

        class Inline(ast.NodeTransformer):
            def visit_Name(self, item: ast.Name) -> ast.AST:
                return ast.copy_location(outer._known(item), item)

            def visit_Attribute(self, item: ast.Attribute) -> ast.AST:
                value = outer._value(item)
                return ast.Constant(float(value)) if isinstance(value, Real) else self.generic_visit(item)

            def visit_Return(self, item: ast.Return) -> ast.AST:
                self.generic_visit(item)
                if outer.pair and isinstance(item.value, ast.Tuple):
                    item.value = item.value.elts[0]
                return item

        found: ast.stmt = ast.fix_missing_locations(Inline().visit(node))
        return found

    def _value(self, node: ast.expr) -> Any:
        """Return what a name of the module stands for, or None."""
        if isinstance(node, ast.Name):
            return None if node.id in self.local else self.names.get(node.id)
        return getattr(self._value(node.value), node.attr, None) if isinstance(node, ast.Attribute) else None

    def _known(self, node: ast.Name) -> ast.expr:
        value = self._value(node)
        if node.id in self.local or (node.id in _BUILT_IN and node.id not in self.names):
            return node
        if isinstance(value, Real):
            return ast.Constant(float(value))
        own = getattr(value, "__name__", "")
        for module, name in ((math, "math"), (np, "np")):
            if value is module:
                return ast.Name(name, ast.Load())
            if value is not None and getattr(module, own, None) is value:
                return ast.Attribute(ast.Name(name, ast.Load()), own, ast.Load())
        raise self.refuse(node)

    def block(self, body: list[ast.stmt]) -> list[str]:
        return [f"    {line}" for item in body for line in self.statement(item)]

    def statement(self, node: ast.stmt) -> list[str]:
        language = self.language
        match node:
            case ast.Return(value=ast.expr() as value):
                first = value.elts[0] if self.pair and isinstance(value, ast.Tuple) else value
                return [language.give.format(value=self.expression(first))]
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                return [language.assign.format(name=self.words[name], value=self.expression(value))]
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=ast.Tuple(elts=values) as value):
                used = {item.id for item in ast.walk(value) if isinstance(item, ast.Name)}
                if used & {getattr(item, "id", "") for item in targets}:
                    raise self.refuse(node)
                pairs = zip(targets, values, strict=True)
                return [line for t, v in pairs for line in self.statement(ast.Assign([t], v))]
            case ast.AugAssign(target=ast.Name(id=name), op=op, value=value):
                whole = ast.BinOp(ast.Name(name, ast.Load()), op, value)
                return [language.assign.format(name=self.words[name], value=self.expression(whole))]
            case ast.If(test=test, body=body, orelse=other):
                lines = [language.begin_if.format(test=self.test(test)), *self.block(body)]
                lines += [language.other.format(), *self.block(other)] if other else []
                return [*lines, language.end_if.format()]
        raise self.refuse(node)

    def expression(self, node: ast.expr) -> str:
        language = self.language
        match node:
            case ast.Constant(value=int() | float() as value) if math.isfinite(value):
                text = repr(float(value))
                return f"({text})" if text.startswith("-") else text
            case ast.Name(id=name) if name in self.words:
                return self.words[name]
            case ast.Name() | ast.Attribute() if isinstance(self._value(node), Real):
                return self.expression(ast.Constant(float(self._value(node))))
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as op, operand=operand):
                return f"({'-' if isinstance(op, ast.USub) else '+'}{self.expression(operand)})"
            case ast.BinOp(op=ast.Pow(), left=left, right=right):
                whole = isinstance(right, ast.Constant) and isinstance(right.value, int)
                return language.power.format(
                    self.expression(left), ast.unparse(right) if whole else self.expression(right)
                )
            case ast.BinOp(op=op) if type(op) in _SIGNS:
                return f"({self.expression(node.left)} {_SIGNS[type(op)]} {self.expression(node.right)})"
            case ast.BoolOp() | ast.Compare() | ast.IfExp() | ast.UnaryOp(op=ast.Not()):
                test, yes, no = self._choice(node)
                return language.choose.format(test=self.test(test), yes=yes, no=no)
            case ast.Call(func=ast.Name() | ast.Attribute(), keywords=[]):
                return self._call(node)
        raise self.refuse(node)

    def _choice(self, node: ast.expr) -> tuple[ast.expr, str, str]:
        """Return the condition of an expression, and its two values."""
        match node:
            case ast.IfExp(test=test, body=yes, orelse=no):
                return test, self.expression(yes), self.expression(no)
            case ast.BoolOp(op=op, values=[left, *others]):  # in Python the value of one of them
                rest = ast.BoolOp(op, others) if others[1:] else others[0]
                yes, no = (rest, left) if isinstance(op, ast.And) else (left, rest)
                return left, self.expression(yes), self.expression(no)
        return node, "1.0", "0.0"

    def test(self, node: ast.expr) -> str:
        """Write an expression as a condition: in Python a number is one, too."""
        language = self.language
        match node:
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return f"({language.no} {self.test(operand)})"
            case ast.BoolOp(op=op, values=values):
                sign = language.both if isinstance(op, ast.And) else language.either
                return "(" + f" {sign} ".join(map(self.test, values)) + ")"
            case ast.Compare(left=left, ops=ops, comparators=others):
                signs = _COMPARED | {ast.NotEq: language.unequal}
                if any(type(op) not in signs for op in ops):
                    raise self.refuse(node)
                terms = [self.expression(item) for item in (left, *others)]
                parts = [f"{terms[i]} {signs[type(op)]} {terms[i + 1]}" for i, op in enumerate(ops)]
                return "(" + f" {language.both} ".join(parts) + ")"
        return f"({self.expression(node)} {language.unequal} 0.0)"

    def _call(self, node: ast.Call) -> str:
        called, value = node.func, self._value(node.func)
        name = called.id if isinstance(called, ast.Name) else getattr(called, "attr", "")
        own = value is None and isinstance(called, ast.Name) and name in _BUILT_IN
        known = value is not None and value in (vars(math).get(name), vars(np).get(name))
        text = self.language.functions.get(name, name if name in _SAME else None)
        if not own and (not known or text is None or name in ("max", "min")):  # of numpy they take an axis
            raise self.refuse(node)
        given = [self.expression(item) for item in node.args]
        if text is None:  # float
            return given[0]
        if name == "log" and given[1:]:
            return f"(log({given[0]}) / log({given[1]}))"

        def written(*given: str) -> str:
            return text.format(*given) if "{" in text else f"{text}({', '.join(given)})"

        while len(given) > 2:  # of max, min and hypot
            given = [written(*given[:2]), *given[2:]]
        return written(*given)
