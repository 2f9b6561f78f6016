"""Saved refiners and monitors whose arrays and numbers were changed: our error, or an object that goes on.

The attack runs in a process of its own, so that a crash of a kernel is a failed test and no end of the tests.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import control as ct
import numpy as np
import pytest

import rcorefine as rco

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
OURS = (rco.RCOError, ct.ControlArgument, ct.ControlDimension)


def cart():
    return rco.mass_spring_damper([0.8, 1.5], [0.2, 0.3], [30.0, 55.0], sensors=("displacement", (1, 2)))


def signals(n, stiffness=55.0, seed=12):
    rng = np.random.default_rng(seed)
    w = 2 * rng.standard_normal((1, n))
    true = rco.mass_spring_damper([0.8, 1.5], [0.2, 0.3], [30.0, stiffness], sensors=("displacement", (1, 2)))
    y = rco.simulate(true, rco.Measurement(w, np.zeros((2, n)), dt=0.02), "zero").outputs
    return w, y + 0.03 * y.std() * rng.standard_normal(y.shape)


def refiner(n, **settings):
    make = rco.RCORefiner.paper if "window" in settings else rco.RCORefiner
    one = make(cart(), dt=0.02, **settings)
    w, y = signals(n, 48.0)
    one.update(w, y)
    return one


def monitor(n, change=None):
    laws = [
        rco.Effect(kind, f"link{i}")
        for kind in ("stiffness", "coulomb_friction", "clearance")
        for i in (1, 2)
    ]
    one = rco.Monitor(cart(), laws, dt=0.02, learn=600)
    w, y = signals(n)
    if change:
        y[:, n // 2 :] = signals(n, change)[1][:, n // 2 :]
    one.update(w, y)
    return one


SAVED = {
    "paper, waiting": lambda: refiner(30, order=2, window=40),
    "paper": lambda: refiner(300, order=2, window=40, history=True),
    "race, starting": lambda: refiner(100),
    "race": lambda: refiner(2300),
    "effects, starting": lambda: refiner(
        200, effects=[rco.Effect("stiffness", "link2")], use_estimated_states=False
    ),
    "effects": lambda: refiner(2200, effects=[rco.Effect("stiffness", "link2")], use_estimated_states=False),
    "nonlinear": lambda: refiner(
        150,
        effects=[rco.Effect("cubic_stiffness", "link1"), rco.Effect("input_delay", "force")],
        use_estimated_states=False,
        history=True,
    ),
    "monitor, learning": lambda: monitor(300),
    "monitor": lambda: monitor(900),
    "monitor, alarm": lambda: monitor(1500, 35.0),
}


# ------------------------------------------------------------------ the attack
def changes_of(array):
    """Names and arrays that stand in the place of one."""
    yield "float32", array.astype(np.float32) if array.dtype.kind in "fiu" else array
    yield "text", np.full(array.shape, "7")
    yield "bool", array.astype(bool)
    yield "complex", array.astype(complex)
    yield "other order of bytes", array.astype(array.dtype.newbyteorder())
    yield (
        "one row more",
        np.concatenate([array, array[-1:]]) if array.ndim and len(array) else array[..., None],
    )
    yield "many rows", np.broadcast_to(np.zeros((), array.dtype), (10**4, *array.shape[1:]))
    yield "one row less", array[:-1] if array.ndim else array
    yield "no row", array[:0] if array.ndim else array
    yield "one axis more", array[None]
    yield "turned", np.asfortranarray(array.T)
    yield "a number", np.zeros((), array.dtype)
    yield "negative", -np.abs(array) - 1 if array.dtype.kind in "fi" else array
    huge = {"i": 2**40, "u": 255, "f": 1e300}.get(array.dtype.kind)
    if huge is not None and array.size:
        yield "huge", np.full_like(array, huge)
        for place in sorted({0, array.size // 2, array.size - 1}):
            for value in {"i": (2**62, -(2**62), -1, 2**33), "u": (2, 200), "f": (np.nan, np.inf, -1e9)}[
                array.dtype.kind
            ]:
                one = array.copy()
                one.flat[place] = value
                yield f"[{place}] = {value}", one


def leaves(tree, path=()):
    """Places of the numbers, texts and nothings in a tree of JSON."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaves(value, (*path, key))
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            yield from leaves(value, (*path, index))
    else:
        yield path, tree


def changed_tree(tree, path, value):
    copy = json.loads(json.dumps(tree))
    part = copy
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    return copy


def mutants(arrays):
    for key, array in arrays.items():
        yield f"{key} missing", {k: v for k, v in arrays.items() if k != key}
        for what, other in () if key == "meta" else changes_of(array):
            yield f"{key} {array.dtype} {array.shape}: {what}", {**arrays, key: other}
    yield "one more", {**arrays, "a9999": np.zeros(3)}
    meta = json.loads(str(arrays["meta"]))
    for path, value in leaves(meta):
        for other in (None, -1, 2**40, 1e308, float("nan"), "text", [], {}, not value):
            yield f"{path} {value!r:.30}: {other!r}", (meta, path, other)


def attack(path, kind, seed, count):
    """Change one thing at a time, load, go on; print each first, so that the last line tells of a crash."""
    warnings.simplefilter("ignore")
    load = rco.Monitor.load if kind.startswith("monitor") else rco.RCORefiner.load
    with np.load(path) as stored:
        arrays = dict(stored)
    w, y = signals(6, 48.0, seed=2)
    refused, choices = 0, list(mutants(arrays))
    again = load(path)  # as it was saved
    again.update(w, y)
    rng = np.random.default_rng(seed)
    for index in rng.choice(len(choices), min(count, len(choices)), replace=False):
        what, content = choices[index]
        print(f"{kind}: {what}", flush=True)
        if isinstance(content, tuple):
            content = {**arrays, "meta": np.array(json.dumps(changed_tree(*content)))}
        np.savez(path, **content)
        try:
            again = load(path)
            again.update(w, y)
            str(again)
            again.history if getattr(again, "_keep", False) else None
        except OURS:
            refused += 1
    print(f"DONE {refused} of {min(count, len(choices))} of {len(choices)} refused")


TOLD = {"refused": 1, "tried": 3}


def test_changed_files_are_refused_or_work(tmp_path, tally):
    """All kinds in one process, which takes longer to start than to do it."""
    work = ["import test_state_files as t"]
    for index, (kind, make) in enumerate(SAVED.items()):
        path = tmp_path / f"state{index}.npz"
        make().save(path)
        work.append(f"t.attack({str(path)!r}, {kind!r}, seed=6, count={tally.cases(40)})")
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(work)],
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{HERE}"},
        capture_output=True,
        text=True,
        timeout=900 * max(1.0, tally.scale),
        check=False,
    )
    lines = done.stdout.strip().splitlines() or ["nothing"]
    assert done.returncode == 0, f"{lines[-1]:.300}\n{done.stderr[-900:]}"
    over = [line.split() for line in lines if line.startswith("DONE")]
    assert len(over) == len(SAVED)
    tally.update({f"state files, {what}": sum(int(one[k]) for one in over) for what, k in TOLD.items()})


# ------------------------------------------------------------------ what is said
def rewritten(path, **changes):
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **{**arrays, **{key: change(arrays[key]) for key, change in changes.items()}})


def test_a_counter_that_points_beyond_the_window_stays_in_it(tmp_path):
    """2**40 as the place in a ring was a segmentation fault; a window takes its rest."""
    path = tmp_path / "state.npz"
    refiner(300, order=2, window=40).save(path)
    with np.load(path) as stored:
        counts = [key for key in stored.files if stored[key].dtype == np.int64 and stored[key].shape == (1,)]
    assert len(counts) == 2
    rewritten(path, **{key: lambda old: old + 40 * 2**35 for key in counts})
    again = rco.RCORefiner.load(path)
    whole = refiner(300, order=2, window=40)
    for one in (again, whole):
        one.update(np.ones((1, 50)), np.ones((2, 50)))
    np.testing.assert_allclose(again.theta, whole.theta, rtol=1e-9)


def test_a_file_of_the_other_kind_is_said_to_be_one(tmp_path):
    refiner(60).save(tmp_path / "refiner.npz")
    monitor(300).save(tmp_path / "monitor.npz")
    with pytest.raises(rco.DataError, match="holds no refiner"):
        rco.RCORefiner.load(tmp_path / "monitor.npz")
    with pytest.raises(rco.DataError, match="holds no monitor"):
        rco.Monitor.load(tmp_path / "refiner.npz")
    np.savez(tmp_path / "list.npz", meta=np.array(json.dumps({"schema": 2, "content": {"list": []}})))
    with pytest.raises(rco.DataError, match="holds no refiner"):
        rco.RCORefiner.load(tmp_path / "list.npz")
    np.savez(tmp_path / "deep.npz", meta=np.array('{"a":' * 5000 + "1" + "}" * 5000))
    with pytest.raises(rco.DataError, match="damaged"):
        rco.RCORefiner.load(tmp_path / "deep.npz")


def test_a_pickled_refiner_holds_no_compiled_code():
    one = refiner(2200, effects=[rco.Effect("stiffness", "link2")], use_estimated_states=False)
    parcel = pickle.dumps(one)
    assert b"numba" not in parcel
    again = pickle.loads(parcel)
    w, y = signals(50, seed=9)
    for each in (one, again):
        each.update(w, y)
    np.testing.assert_array_equal(one.static_theta, again.static_theta)
