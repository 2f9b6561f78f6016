"""One thread at a time in whatever is asked of a stream; copies beside an update; forks."""

from __future__ import annotations

import copy
import inspect
import os
import pickle
import signal
import sys
import threading
import time

import numpy as np
import pytest

import rcorefine as rco
from rcorefine.exceptions import ONE_THREAD, own_arithmetic

STEPS = 30
W = np.random.default_rng(0).standard_normal((STEPS, 20))
NOISE = 1e-3 * np.random.default_rng(1).standard_normal(W.shape)


@pytest.fixture(scope="module")
def samples():
    model = rco.mass_spring_damper(1.0, 0.4, 100.0, sensors="displacement")
    blank = rco.Measurement(W.ravel(), np.zeros(W.size), dt=0.05)
    return model, rco.simulate(model, blank, "zero").outputs.reshape(W.shape) + NOISE


def stream_of(kind, model):
    if kind is rco.RCORefiner:
        return kind(model, dt=0.05)
    return kind(model, [rco.Effect("stiffness", "link1")], dt=0.05, learn=200)


def taught(kind, samples, blocks=15):
    model, y = samples
    stream = stream_of(kind, model)
    stream.update(W[:blocks].ravel(), y[:blocks].ravel())
    return stream


KINDS = pytest.mark.parametrize("kind", [rco.RCORefiner, rco.Monitor])


@KINDS
def test_whatever_is_asked_waits_for_the_call_that_runs(kind, samples, tmp_path):
    """Every public function and property, those that another base class brings, and the special ones."""
    stream, w = taught(kind, samples), W[20]
    given = {
        "update": (w, samples[1][20]), "predict": (w,), "save": (tmp_path / "one.npz",),
        "run": (rco.Measurement(w, samples[1][20], dt=0.05),), "__setstate__": ({},),
        "__init__": (samples[0],),
    }  # fmt: skip
    calls = {
        "str": lambda: str(stream), "repr": lambda: repr(stream), "pickle": lambda: pickle.dumps(stream),
        "copy": lambda: copy.copy(stream), "deepcopy": lambda: copy.deepcopy(stream),
    }  # fmt: skip
    for name in dir(kind):
        member = inspect.getattr_static(kind, name)
        if name.startswith("_") and not name.endswith("_"):
            continue
        if isinstance(member, property):
            calls[name] = lambda name=name: getattr(stream, name)
        elif inspect.isfunction(member):
            calls[name] = lambda name=name: getattr(stream, name)(*given.get(name, ()))
    assert {"update", "n_samples", "answer", "to_dict", "_repr_html_", "__getstate__"} <= calls.keys()
    done = []

    def call(name):
        try:
            calls[name]()
        except Exception:  # an answer, too: some of these calls have no sense here
            pass
        done.append(name)

    threads = [
        threading.Thread(target=call, args=(name,)) for name in calls if name not in ("plot", "bode_plot")
    ]
    with stream._lock:
        for thread in threads:
            thread.start()
        time.sleep(0.1)
        assert done == []
    for thread in threads:
        thread.join(20)
    assert len(done) == len(threads)


@KINDS
def test_signatures_and_docstrings_are_those_of_the_methods(kind):
    assert [*inspect.signature(kind.update).parameters] == ["self", "w", "y"]
    assert inspect.getdoc(kind.n_samples) == "Number of samples taken."
    assert kind.update.__module__ == kind.__module__
    assert [*inspect.signature(type("Mine", (kind,), {}).update).parameters] == ["self", "w", "y"]


@KINDS
def test_a_copy_beside_an_update_holds_a_state_that_was(kind, samples):
    y = samples[1]

    def state(one):
        seen = one.static_theta if kind is rco.RCORefiner else one.statistic
        return one.n_samples, seen.tobytes()

    twin, live, right = taught(kind, samples, 1), taught(kind, samples, 1), set()
    right.add(state(twin))
    for k in range(1, STEPS):
        twin.update(W[k], y[k])
        right.add(state(twin))
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    thread = threading.Thread(target=lambda: [live.update(W[k], y[k]) for k in range(1, STEPS)])
    thread.start()
    try:
        copies = [live]
        while thread.is_alive():
            copies += [pickle.loads(pickle.dumps(live)), copy.deepcopy(live)]
    finally:
        thread.join()
        sys.setswitchinterval(interval)
    assert {state(one) for one in copies} <= right
    assert len(copies) > 2


@KINDS
def test_what_was_handed_out_stays_as_it_was(kind, samples):
    """What a property returns is no memory that the next update changes."""
    stream = taught(kind, samples)
    names = [name for name in dir(kind) if isinstance(getattr(kind, name), property) and name[0] != "_"]
    names = [name for name in names if name not in ("history", "system", "discrete_system")]
    found = {name: getattr(stream, name) for name in names}
    before = {name: pickle.dumps(one) for name, one in found.items()}
    stream.update(W[15], samples[1][15])
    assert [name for name in names if pickle.dumps(found[name]) != before[name]] == []


forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")


def child_of(work):
    """Exit code of a child that works; one that hangs dies of it."""
    child = os.fork()
    if child == 0:
        signal.alarm(10)
        code = 1
        try:
            code = work()
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@forks
def test_a_child_does_not_wait_for_a_thread_that_sets_the_threads_of_blas():
    """The lock of that setting is free in the child, and threads that computed are not counted there."""
    inside, leave = threading.Event(), threading.Event()

    def compute():
        with own_arithmetic():
            with ONE_THREAD.lock:
                inside.set()
                time.sleep(0.1)
            leave.wait()

    thread = threading.Thread(target=compute)
    thread.start()
    inside.wait()

    def work():
        before = list(ONE_THREAD.inside)
        with own_arithmetic():
            return len(before) + 2 * (len(ONE_THREAD.inside) - 1)

    try:
        assert child_of(work) == 0
        assert len(ONE_THREAD.inside) == 1
    finally:
        leave.set()
        thread.join()


@forks
@KINDS
@pytest.mark.parametrize("twin", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_fork_waits_for_the_calls_that_run_and_for_no_other(kind, twin, samples):
    """Threads that ask again and again do not keep a fork waiting; their copies work in the child."""
    streams = [twin(taught(kind, samples)) for _ in range(3)]
    stop, inside = threading.Event(), threading.Barrier(4)

    def ask(stream):
        inside.wait()
        while not stop.is_set():
            with stream._lock:
                time.sleep(0.02)

    threads = [threading.Thread(target=ask, args=(one,)) for one in streams]
    for thread in threads:
        thread.start()
    inside.wait()

    def work():
        for one in streams:
            one.update(W[20], samples[1][20])
        return 0

    begun = time.monotonic()
    try:
        assert child_of(work) == 0
        assert time.monotonic() - begun < 5
    finally:
        stop.set()
        for thread in threads:
            thread.join()
