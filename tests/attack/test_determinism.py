"""One answer whatever computes it: compiled or not, more workers, more threads of the linear algebra."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from inner import NUMBA

import rcorefine as rco

SOFT = {"cubic_stiffness": 20.0}
HERE = Path(__file__).resolve().parent


def case(seed, samples=120):
    """Two masses with a hardening spring that the model lacks."""
    rng = np.random.default_rng(seed)
    m, c, k = rng.uniform(0.5, 2, 2), rng.uniform(0.3, 1, 2), rng.uniform(10, 60, 2)
    model = rco.mass_spring_damper(m, c, k, sensors="displacement")
    w = 5 * rng.standard_normal(samples)
    blank = rco.Measurement(w, np.zeros((2, samples)), dt=0.05)
    cubic = rco.Effect("cubic_stiffness", "link1")
    true = rco.refine(model, blank_run(model, blank), [cubic.replace(fixed={"cubic_stiffness": 30.0})])
    y = rco.simulate(true, blank, "zero").outputs
    return model, rco.Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=0.05), cubic


def blank_run(model, blank):
    return rco.Measurement(blank.inputs, rco.simulate(model, blank, "zero").outputs, dt=0.05)


def figures(seeds):
    """A row per record: what `compare` says of three models; coefficients, and their standard deviations."""
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rco.RCOWarning)
        for seed in seeds:
            model, data, cubic = case(seed)
            linear = rco.refine(model, data, [rco.Effect("stiffness", "link2")])
            law = rco.refine(model, data, [cubic])
            held = [rco.Effect("stiffness", "link2", fixed={"stiffness": 3.0}), cubic.replace(fixed=SOFT)]
            apart = rco.refine(model, data, held, offset=False)
            fits = rco.compare([model, apart], data).fit.ravel()
            theta = np.r_[linear.theta, law.theta]
            std = np.sqrt(np.r_[np.diag(linear.covariance), np.diag(law.covariance)])
            found.append([*fits.tolist(), *theta.tolist(), *std.tolist()])
    return found


def same(one, other):
    """`compare` to 1e-10; `refine` to 1e-5 of its standard deviations."""
    one, other = np.array(one), np.array(other)
    n = (one.shape[1] - 4) // 2
    np.testing.assert_allclose(other[:, :4], one[:, :4], rtol=1e-10)
    off = np.abs(other[:, 4 : 4 + n] - one[:, 4 : 4 + n])
    assert np.all(off <= 1e-5 * one[:, 4 + n :])
    np.testing.assert_allclose(other[:, 4 + n :], one[:, 4 + n :], rtol=1e-5)


def elsewhere(seeds, **settings):
    """The same in a process of its own."""
    code = f"import json, test_determinism as t; print(json.dumps(t.figures({list(seeds)})))"
    paths = [str(HERE), str(HERE.parent), str(Path(rco.__file__).parents[1])]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **settings}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.numba
@pytest.mark.skipif(not NUMBA, reason="numba is not installed or switched off")
def test_compiled_or_not(tally):
    seeds = range(tally.cases(1) if tally.scale == 1 else 20)
    same(figures(seeds), elsewhere(seeds, RCOREFINE_NUMBA="0"))
    tally["determinism, records with and without numba"] += len(seeds)


def test_threads_of_the_linear_algebra(tally):
    seeds = range(min(tally.cases(1), 100))
    one, two = (
        elsewhere(seeds, OMP_NUM_THREADS=n, OPENBLAS_NUM_THREADS=n, MKL_NUM_THREADS=n) for n in ("1", "2")
    )
    same(one, two)
    tally["determinism, records with one and two threads of BLAS"] += len(seeds)


def test_one_worker_or_eight(tally):
    """Bitwise: who computes what changes no answer."""
    effects = [rco.Effect(kind, f"link{i}") for kind in ("stiffness", "cubic_stiffness") for i in (1, 2)]
    pool = ProcessPoolExecutor if tally.scale > 1 else ThreadPoolExecutor
    for seed in range(min(tally.cases(1), 20)):
        model, data, _ = case(seed, 240)
        other = case(seed + 1000, 240)[1]
        fleet = {f"m{i}": record for i, record in enumerate((data, other, data))}
        found = []
        for workers in (1, 8):
            with pool(workers) as executor, warnings.catch_warnings():
                warnings.simplefilter("ignore", rco.RCOWarning)
                told = rco.diagnose(model, data, candidates=effects, executor=executor)
                options = {"effects": [rco.Effect("cubic_stiffness", "link1")]}
                rows = rco.survey(model, fleet, "refine", options=options, executor=executor)
                table = rows.to_dict()
                for row in table["rows"]:
                    row.pop("seconds")
                found.append((json.dumps(told.to_dict()), json.dumps(table)))
        assert found[0] == found[1]
        tally["determinism, records with one and eight workers"] += 1
