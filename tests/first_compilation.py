"""The large kernels compiled once, where several processes would each begin with them.

Under pytest-xdist every worker would compile the same kernels at the same time; each one takes a share,
and reads those of the others from numba's cache.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from inner import NUMBA

import rcorefine as rco

LONGEST = 300.0  # s that a worker waits for the others


def compile_kernels(share: int = 0, shares: int = 1) -> None:
    """One short use of each estimator, of those that fall to a share."""
    model = rco.mass_spring_damper([1.0], [0.4], [60.0], sensors="velocity")
    rng = np.random.default_rng(0)
    w = rng.standard_normal(400)
    y = rco.simulate(model, rco.Measurement(w, np.zeros(400), dt=0.05), "zero").outputs[0]
    data = rco.Measurement(w, y + 0.05 * y.std() * rng.standard_normal(400), dt=0.05)
    linear, cubic = rco.Effect("stiffness", "link1"), rco.Effect("cubic_stiffness", "link1")

    def stream(**settings: Any) -> None:
        make = rco.RCORefiner.paper if "window" in settings else rco.RCORefiner
        make(model, dt=data.dt, **settings).run(data)

    uses = (
        lambda: rco.refine(model, data, [cubic]),
        lambda: (stream(), stream(order=2, window=30), stream(effects=[linear]), stream(effects=[cubic])),
        lambda: rco.Monitor(model, [linear, cubic], dt=data.dt, learn=300).run(data),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for use in uses[share::shares]:
            use()


def compile_once(config: pytest.Config) -> None:
    """A share in each worker; then each waits until all are done."""
    worker = getattr(config, "workerinput", None)
    if worker is None or not NUMBA:
        return
    count, own = int(worker["workercount"]), int(worker["workerid"].removeprefix("gw"))
    done = [Path(tempfile.gettempdir()) / f"rcorefine-{worker['testrunuid']}-{k}" for k in range(count)]
    try:
        compile_kernels(own, count)
    finally:
        done[own].touch()
    until = time.monotonic() + LONGEST
    while not all(path.exists() for path in done) and time.monotonic() < until:
        time.sleep(0.1)
