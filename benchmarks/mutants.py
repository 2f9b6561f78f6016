"""How many wrong lines the tests see: one-line mutants of laws, estimators and decisions, drawn at random.

In a temporary copy the default tests run, those first that name the mutated module. A run may be stopped:
the same call goes on from its table. A mutant that is equivalent to the code counts as not seen.

    python benchmarks/mutants.py --mutants 100 --seed 1 --out mutants.csv  # hours
"""

from __future__ import annotations

import argparse
import ast
import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = "inference diagnosis localization effects comparison streaming refinement engine".split()
FIELDS = ("file", "line", "change", "seen", "by", "seconds")
SWAPPED = {
    ast.Lt: ("<", ">="), ast.LtE: ("<=", ">"), ast.Gt: (">", "<="), ast.GtE: (">=", "<"), ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}  # fmt: skip
OPERANDS = {
    ast.Compare: ("left", "ops", "comparators"), ast.BinOp: ("left", "op", "right"),
    ast.BoolOp: ("values", "op", "values"),
}  # fmt: skip


def computing(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that compute: no messages, annotations and decorators."""
    yield node
    for name, value in ast.iter_fields(node):
        for inner in value if isinstance(value, list) else [value]:
            told = isinstance(inner, ast.Raise | ast.JoinedStr) or name in ("annotation", "returns")
            if isinstance(inner, ast.AST) and not told and name != "decorator_list":
                yield from computing(inner)


def edit_of(node: ast.AST, lines: list[bytes]) -> tuple[int, int, str] | None:
    """Return where a node is changed in its line, and into what; None if it is left alone."""
    if getattr(node, "lineno", 0) == 0 or node.lineno != node.end_lineno:
        return None
    line, here, end = lines[node.lineno - 1], node.col_offset, node.end_col_offset
    for kind, names in OPERANDS.items():
        if isinstance(node, kind):
            parts = [np.atleast_1d(np.array(getattr(node, name), dtype=object)) for name in names]
            old, new = SWAPPED.get(type(parts[1][0]), ("~", ""))
            at = line.find(old.encode(), parts[0][0].end_col_offset, parts[2][-1].col_offset)
            return (at, at + len(old), new) if at >= 0 and len(parts[1]) == 1 else None
    if isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value:
        larger = float(f"{1.5 * node.value:.12g}")
        return here, end, repr(larger if isinstance(node.value, float) else round(larger + 0.01))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return here, here + len("not "), ""
    if isinstance(node, ast.Return) and isinstance(node.value, ast.BinOp | ast.Call):
        return here, end, f"return -({line[here + len('return') : end].decode().strip()})"
    return None


def mutants() -> list[tuple[str, int, int, int, str]]:
    """All mutants: file, line, first and last byte that are replaced, and by what."""
    found = []
    for path in sorted(path for folder in FOLDERS for path in (ROOT / "rcorefine" / folder).rglob("*.py")):
        lines = path.read_bytes().split(b"\n")
        edits = [(node, edit_of(node, lines)) for node in computing(ast.parse(path.read_bytes()))]
        found += [(path.relative_to(ROOT).as_posix(), node.lineno, *edit) for node, edit in edits if edit]
    return found


def run(copy: Path, tests: list[str], limit: float) -> str:
    """Run tests in the copy; return the first that fails, "timeout", or an empty string."""
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "2", "-p", "no:cacheprovider", *tests]
    out = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    made = subprocess.Popen(words, cwd=copy, env=os.environ | {"OMP_NUM_THREADS": "1"}, **out)
    try:
        said, code = made.communicate(timeout=limit)[0], made.returncode
    except subprocess.TimeoutExpired:
        os.killpg(made.pid, signal.SIGKILL)  # with its workers, which are of its session
        return "timeout"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+?(?:\[.*?\])?)(?: - |$)", said, re.MULTILINE)
    ended = f"pytest ends with {code}" if code not in (0, 5) else ""  # 5: no test of the default set
    return failed[1] if failed else ended


def tried(copy: Path, path: Path, mutated: bytes, limit: float) -> str:
    """Return the test that sees a file which is changed, or an empty string."""
    name = re.compile(rf"\b{path.stem if path.stem != '__init__' else path.parent.name}\b")
    tests = sorted((copy / "tests").glob("test_*.py"))
    first = [str(one) for one in tests if name.search(one.read_text(encoding="utf-8"))]
    rest = [str(one) for one in tests if str(one) not in first]
    source, by = path.read_bytes(), ""
    for content in (mutated, source):
        path.write_bytes(content)
        for cache in copy.rglob("*.nbi") if b"@compiled" in source else ():  # of callers, with the old kernel
            cache.unlink()
        if content is mutated:
            by = (run(copy, first, limit) if first else "") or run(copy, [*rest, "rcorefine"], limit)
    if "::" in by and run(copy, [by], limit):
        raise SystemExit(f"{by} fails without a mutant, too: mend it first")
    return by


def main() -> None:
    """Draw mutants until the table holds as many as are asked for."""
    parser = argparse.ArgumentParser()
    for name, default in (("mutants", 100), ("seed", 1), ("out", "mutants.csv"), ("timeout", 1800.0)):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    asked = parser.parse_args()
    table = list(csv.DictReader(open(asked.out, encoding="utf-8"))) if Path(asked.out).exists() else []
    known, every = {(row["file"], row["line"], row["change"]) for row in table}, mutants()
    with tempfile.TemporaryDirectory() as folder, open(asked.out, "a", encoding="utf-8") as out:
        writer, copy = csv.DictWriter(out, FIELDS), Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", "_build", ".pytest_cache"))
        if not table:
            writer.writeheader()
        for k in np.random.default_rng(asked.seed).permutation(len(every)):
            if len(table) >= asked.mutants:
                break
            file, number, start, end, text = every[k]
            lines, begun = (copy / file).read_bytes().split(b"\n"), time.monotonic()
            line = lines[number - 1]
            lines[number - 1] = line[:start] + text.encode() + line[end:]
            change = f"{line.decode().strip()} -> {lines[number - 1].decode().strip()}"
            if (file, str(number), change) in known:
                continue
            by = tried(copy, copy / file, b"\n".join(lines), asked.timeout)
            row = file, number, change, bool(by), by, round(time.monotonic() - begun)
            table.append(dict(zip(FIELDS, map(str, row), strict=True)))
            writer.writerow(table[-1])
            out.flush()
            print(f"{file}:{number} {change} | {by or 'NOT SEEN'}", flush=True)
    seen = sum(row["seen"] == "True" for row in table)
    low, high = binomtest(seen, len(table)).proportion_ci(0.95, "exact")
    print(f"{seen} of {len(table)} seen ({len(every)} possible): 95 % interval {low:.2f} to {high:.2f}")


if __name__ == "__main__":
    main()
