"""Bad values for every argument of every callable that can be reached, drawn from what signatures say.

`test_bad_arguments` knows what each argument may be, from a list. Here nothing is listed: a new name, or a
new method of a result, is attacked as soon as it exists. A raw error is one that is not ours, or that names
neither the argument nor what to do; a silent one is a result with NaN or infinity in it and no warning.
"""

from __future__ import annotations

import contextlib
import functools
import random
import re
import warnings
from typing import Any
from unittest import mock

import by_signature
import matplotlib.pyplot as plt
import numpy as np
from public_calls import Call
from test_bad_arguments import OURS, VALUES, _begin, _Begun, _in_time, _stopped

import rcorefine as rco

RAW = 1e-3  # of all calls
#: What a message says that tells what to do.
REMEDY = re.compile(
    r"\b(give|use|must|one of|choose|expected|needs?|take|install|set|pass|write|leave|there (is|are)|its \w+"
    r" are|the \w+ are|has (no|only)|lists?)\b",
    re.IGNORECASE,
)


def says_enough(error: Exception, argument: str, value: object) -> bool:
    """Whether a message names the argument, quotes what was given, or says what to do."""
    said = str(error).lower()
    names = {argument, argument.rstrip("s"), argument.replace("_", " "), argument.rpartition("_")[2]}
    return (
        any(name.lower() in said for name in names)
        or (bool(str(value).strip()) and str(value).lower() in said)
        or REMEDY.search(said) is not None
    )


@functools.cache
def usual(name: str, *, whole: bool) -> tuple[bool, frozenset[str]]:
    """Whether the valid call goes to its end, and where its result is not finite."""
    target = by_signature.targets()[name]
    with warnings.catch_warnings(), stopped(name, whole=whole):
        warnings.simplefilter("ignore")
        try:
            return True, frozenset(by_signature.not_finite(target.function()(**target.valid())))
        except (_Begun, Exception):
            return False, frozenset()


@contextlib.contextmanager
def stopped(name: str, *, whole: bool):
    target = by_signature.targets()[name]
    call = Call(target.function, target.valid, work=target.work)
    with _stopped(call, whole=whole), mock.patch("rcorefine.explorer.serving.needed", _begin):
        yield


def attack(name: str, argument: str, value: Any, *, whole: bool) -> tuple[str, str]:
    """Kind of outcome, and what was wrong."""
    target = by_signature.targets()[name]
    ends, excused = usual(name, whole=whole)
    with warnings.catch_warnings(record=True) as heard, stopped(name, whole=whole and ends), _in_time():
        warnings.simplefilter("always")
        try:
            found = target.function()(**{**target.valid(), argument: value})
        except _Begun:
            return "taken", ""
        except Exception as error:
            raw = not isinstance(error, OURS) or isinstance(error, TimeoutError)
            if raw or not (isinstance(error, OSError) or says_enough(error, argument, value)):
                return "raw", f"{type(error).__name__}: {error}"
            return "refused", ""
        finally:
            plt.close("all")
    foreign = [each for each in heard if not issubclass(each.category, rco.RCOWarning)]
    if foreign:
        return "raw", f"{foreign[0].category.__name__}: {foreign[0].message}"
    lost = by_signature.not_finite(found) - excused
    if lost and not heard and not (isinstance(value, float | np.inexact) and np.isinf(value)):
        return "silent", f"not finite: {sorted(lost)}"
    return "taken", ""


def test_every_public_name_is_reached():
    """The roots and what they hold: constructors, functions, methods of results, and what those return."""
    found = by_signature.targets()
    functions = {"refine", "Measurement.from_csv", "Monitor.load", "exercises.grade"}
    methods = {"Refinement.parameter", "RCORefiner.update", "ExperimentAdvice.to_dict", "Exploration.add"}
    assert functions | methods <= found.keys()
    assert not [name for name in found if "._" in name]


def test_arguments_from_signatures(tally, tmp_path, monkeypatch):
    """At most 0.1 % are raw, none is silent; a longer run takes every value and works to the end."""
    monkeypatch.chdir(tmp_path)
    drawn, whole, wrong = random.Random(31), tally.scale > 1, []
    count = dict.fromkeys(("refused", "taken", "raw", "silent"), 0)
    for name, target in sorted(by_signature.targets().items()):
        for argument in target.arguments:
            for what in drawn.sample(sorted(VALUES), min(len(VALUES), tally.cases(6))):
                kind, why = attack(name, argument, VALUES[what](), whole=whole)
                count[kind] += 1
                if why:
                    wrong.append(f"{name}({argument}={what}): {kind}: {why}")
    for kind, number in count.items():
        tally[f"arguments by signature, {kind}"] += number
    assert count["silent"] == 0, "\n".join(wrong)
    assert count["raw"] <= RAW * sum(count.values()), "\n".join(wrong)
