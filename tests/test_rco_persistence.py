"""Save, load, go on: bit by bit as if it had never stopped; a damaged file is said to be one."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import control as ct
import numpy as np
import pytest
from test_rco_effects import DAMPING, STIFFNESS, chain, sampled

import rcorefine as rco
from rcorefine import Effect, RCORefiner


def cube(d, v):
    return d**3


def open_cube(d, v, **coefficients):
    return coefficients["c"] * d**3


CUBIC = [Effect("custom", "link2", law=cube)]


def cases():
    physical = {"model": chain(), "dt": 0.02, "effects": STIFFNESS}
    nonlinear = [Effect("cubic_stiffness", "link2"), Effect("input_delay", "force")]
    return {
        "paper": {
            "model": chain().system,
            "dt": 0.02,
            "order": 2,
            "window": 40,
            "markov": 1,
            "learning_rate": 100.0,
        },
        "effects": physical,
        "effects with history and gaps": {**physical, "history": True, "missing": "hold-out"},
        "nonlinear with a delay": {**physical, "effects": nonlinear, "use_estimated_states": False},
        "forgetting, plain model": {
            **physical,
            "model": rco.mass_spring_damper([1, 1, 1], DAMPING, [10, 8, 6]).system,
            "effects": [Effect("damping", "q1")],
            "forgetting": 0.999,
            "use_estimated_states": False,
        },
    }


def stream(case, n_samples=600):
    w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, n_samples, 0.05, 1)
    if "plain" in case:
        y = np.vstack([y, y[:1]])
    if "gaps" in case:
        y = y.copy()
        y[np.random.default_rng(0).random(y.shape) < 0.1] = np.nan
        y[:, 0] = 0.0
    return w, y


def same(one, other):
    assert one.n_samples == other.n_samples
    np.testing.assert_array_equal(one.static_theta, other.static_theta)
    np.testing.assert_array_equal(one.theta, other.theta)
    if one.effects is not None:
        np.testing.assert_array_equal(one.covariance, other.covariance)
        ours, theirs = (refiner._estimator.static.memory for refiner in (one, other))
        np.testing.assert_array_equal(ours.packed, theirs.packed)
    assert str(one) == str(other)


@pytest.mark.parametrize("case", cases())
def test_going_on_after_twenty_random_cuts_is_bitwise_the_same(case, tmp_path):
    settings, (w, y) = cases()[case], stream(case)
    whole, cut = RCORefiner(**settings), RCORefiner(**settings)
    cuts = np.sort(np.random.default_rng(2).choice(np.arange(1, w.shape[1]), 20, replace=False))
    for part in np.split(np.arange(w.shape[1]), cuts):
        whole.update(w[:, part], y[:, part])
        cut.update(w[:, part], y[:, part])
        cut.save(tmp_path / "state.npz")
        del cut
        cut = RCORefiner.load(tmp_path / "state.npz")
        same(whole, cut)
    if settings.get("history"):
        np.testing.assert_array_equal(whole.history.coefficients, cut.history.coefficients)
        np.testing.assert_array_equal(whole.history.z2, cut.history.z2)
        np.testing.assert_array_equal(whole.history.x_D, cut.history.x_D)


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    w, y = stream("effects")
    refiner, path = RCORefiner(**cases()["effects"]), tmp_path / "state.npz"
    refiner.update(w[:, :300], y[:, :300])
    refiner.save(path)
    before = path.read_bytes()
    refiner.update(w[:, 300:], y[:, 300:])

    def broken(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(OSError, match="disk full"):
        refiner.save(path)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["state.npz"]


def test_a_state_of_an_older_version_is_refused_with_a_sentence():
    with pytest.raises(rco.DataError, match="schema version 1.* begin anew from its refined model"):
        RCORefiner.load(Path(__file__).with_name("state_of_0_1.npz"))


def test_files_that_are_none_are_refused(tmp_path):
    path = tmp_path / "state.npz"
    with pytest.raises(FileNotFoundError):
        RCORefiner.load(path)
    path.write_bytes(b"no archive")
    with pytest.raises(rco.DataError, match="damaged"):
        RCORefiner.load(path)
    np.savez(path, meta=np.array({"schema": 1}, dtype=object))
    with pytest.raises(rco.DataError, match="damaged"):  # a pickle is never opened
        RCORefiner.load(path)
    np.savez(path, meta=np.array(json.dumps({"schema": 99, "content": None})))
    with pytest.raises(rco.DataError, match="schema version 99"):
        RCORefiner.load(path)


def test_nothing_is_pickled(tmp_path):
    w, y = stream("effects")
    refiner, path = RCORefiner(**cases()["effects"]), tmp_path / "state.npz"
    refiner.update(w, y)
    refiner.save(path)
    with np.load(path, allow_pickle=False) as stored:
        assert all(stored[key].dtype != object for key in stored.files)


@pytest.mark.parametrize("law", [cube, lambda d, v: d**3], ids=["named", "nameless"])
def test_custom_laws_are_found_or_handed_over_again(tmp_path, monkeypatch, law):
    w, y = stream("effects", 200)
    named, effects = law is cube, [Effect("custom", "link2", law=law)]
    refiner, path = (
        RCORefiner(chain(), dt=0.02, effects=effects, use_estimated_states=False),
        tmp_path / "x.npz",
    )
    refiner.update(w[:, :20], y[:, :20])
    refiner.save(path)
    if named:
        found = RCORefiner.load(path)
        monkeypatch.delattr(sys.modules[cube.__module__], "cube")  # as where the module is another one
    with pytest.raises(rco.ModelError, match="laws="):
        RCORefiner.load(path)
    again = RCORefiner.load(path, laws={"custom at link2": law})
    for one in (refiner, again, *([found] if named else [])):
        one.update(w[:, 20:120], y[:, 20:120])
        np.testing.assert_array_equal(refiner.static_theta, one.static_theta)


def edited(path, old, new):
    """The file with another text in its description."""
    with np.load(path) as stored:
        arrays = dict(stored)
    text = str(arrays.pop("meta"))
    assert json.dumps(old) in text
    np.savez(path, meta=np.array(text.replace(json.dumps(old), json.dumps(new))), **arrays)


@pytest.mark.parametrize("kind", [RCORefiner, rco.Monitor])
@pytest.mark.parametrize(
    "law",
    [
        "evil:law", "evil.inner:law", "evil", ":", "os:removedirs", "shutil:rmtree", "builtins:exec",
        "importlib:import_module", "subprocess:getoutput", "os.path:join", "rcorefine:evil.law",
        "numpy:DataSource", "scipy:evil.law", "rcorefine.effects.law:register",
        "test_rco_persistence:os.getcwd", "test_rco_persistence:Effect",
        "test_rco_persistence:cube.__globals__", "test_rco_persistence:renamed", "__main__:wipe",
    ],
)  # fmt: skip
def test_no_file_says_what_is_imported_or_called(tmp_path, monkeypatch, law, kind):
    """Only laws of modules that are imported already: no module beside the file, no library's function."""
    (tmp_path / "evil.py").write_text(
        f"open({str(tmp_path / 'ran')!r}, 'w')\n\ndef law(d, v):\n    return d\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys.modules[cube.__module__], "renamed", np.add, raising=False)

    def wipe(d, v):
        (tmp_path / "ran").write_text("wiped")
        return 0.0 * d

    wipe.__module__, wipe.__qualname__ = "__main__", "wipe"
    monkeypatch.setattr(sys.modules["__main__"], "wipe", wipe, raising=False)
    saved = kind(chain(), dt=0.02, **{"effects" if kind is RCORefiner else "candidates": CUBIC})
    saved.save(tmp_path / "state.npz")
    edited(tmp_path / "state.npz", f"{cube.__module__}:cube", law)
    before = set(sys.modules)
    with pytest.raises(rco.RCOError, match=r"laws=\{'custom at link2': law\}"):
        kind.load(tmp_path / "state.npz")
    assert set(sys.modules) == before
    assert not (tmp_path / "ran").exists()
    kind.load(tmp_path / "state.npz", laws={"custom at link2": cube})


def test_names_of_coefficients_are_no_code(tmp_path):
    """They stand in the source that is compiled for a law."""
    effects = [Effect("custom", "link2", law=open_cube, start={"c": 1.0})]
    RCORefiner(chain(), dt=0.02, effects=effects).save(tmp_path / "state.npz")
    for name in (f"c=1) or open({str(tmp_path / 'ran')!r}, 'w') and dict(c", "lambda", "", "c\n"):
        with pytest.raises(ct.ControlArgument, match="a Python name"):
            Effect("custom", "link2", law=open_cube, start={name: 1.0})
    edited(tmp_path / "state.npz", "c", f"c=1) or open({str(tmp_path / 'ran')!r}, 'w') and dict(c")
    with pytest.raises(ct.ControlArgument, match="a Python name"):
        RCORefiner.load(tmp_path / "state.npz")
    assert not (tmp_path / "ran").exists()


def test_memory_and_file_stay_the_same_size(tmp_path):
    w, y, _ = sampled(chain((10, 5.6, 6)), 0.02, 6000, 0.05, 1)
    refiner, path = RCORefiner(chain(), dt=0.02, effects=STIFFNESS), tmp_path / "state.npz"
    sizes = []
    for begin in (0, 2500, 4000):
        end = {0: 2500, 2500: 4000, 4000: 6000}[begin]
        refiner.update(w[:, begin:end], y[:, begin:end])
        refiner.save(path)
        sizes.append(path.stat().st_size)
    assert max(sizes) - min(sizes) < 200  # digits of counters
