"""The large kernels compiled once, where several processes would each begin with them.

Under pytest-xdist every worker would compile the same kernels at the same time; the first one does it,
and the others read them from numba's cache.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from inner import NUMBA

import rcorefine as rco

LONGEST = 300.0  # s that a worker waits for the first one


def compile_kernels() -> None:
    """One short use of each estimator."""
    model = rco.mass_spring_damper([1.0], [0.4], [60.0], sensors="velocity")
    rng = np.random.default_rng(0)
    w = rng.standard_normal(400)
    y = rco.simulate(model, rco.Measurement(w, np.zeros(400), dt=0.05), "zero").outputs[0]
    data = rco.Measurement(w, y + 0.05 * y.std() * rng.standard_normal(400), dt=0.05)
    linear, cubic = rco.Effect("stiffness", "link1"), rco.Effect("cubic_stiffness", "link1")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rco.refine(model, data, [cubic])
        for settings in ({}, {"order": 2, "window": 30}, {"effects": [linear]}, {"effects": [cubic]}):
            rco.RCORefiner(model, dt=data.dt, **settings).run(data)
        rco.Monitor(model, [linear, cubic], dt=data.dt, learn=300).run(data)


def compile_once(config: pytest.Config) -> None:
    """In the first worker; the others wait until it is done."""
    worker = getattr(config, "workerinput", None)
    if worker is None or not NUMBA:
        return
    done = Path(tempfile.gettempdir()) / f"rcorefine-{worker['testrunuid']}"
    if worker["workerid"] == "gw0":
        try:
            compile_kernels()
        finally:
            done.touch()
    else:
        until = time.monotonic() + LONGEST
        while not done.exists() and time.monotonic() < until:
            time.sleep(0.1)
