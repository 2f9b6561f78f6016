"""Places that stay in the race where a structure has many."""

import numpy as np
from inner import fitted_from
from scipy.linalg import expm

import rcorefine as rco
from rcorefine.diagnosis.residual_tests import in_race


def chain(n, links):
    """A chain with that many links in race, and a record of it with play in the fourth link."""
    rng = np.random.default_rng(7)
    m, c, k = np.ones(n), 0.05 * np.ones(n), 200.0 * np.ones(n)
    model = rco.mass_spring_damper(m, c, k, sensors=[("velocity", n)])
    A, B, C = (np.asarray(getattr(model.system, key)) for key in "ABC")
    port = model.port("link4")
    dt, N = 0.03, 2000
    E = expm(np.block([[A, B, port.act[:, None]], [np.zeros((2, 2 * n + 2))]]) * dt / 4)
    x, y, w = np.zeros(2 * n), np.zeros(N), rng.standard_normal(N)
    for i in range(N):
        y[i] = (C @ x)[0]
        for _ in range(4):  # a cubic spring, its force held over a quarter of a sample
            d = port.position @ x
            x = E[:-2, :-2] @ x + E[:-2, -2] * w[i] + E[:-2, -1] * 4e4 * d**3
    return model, rco.Measurement(w, y + 0.02 * y.std() * rng.standard_normal(N), dt=dt)


class TestInRace:
    def test_the_true_place_stays_and_most_others_go(self):
        model, data = chain(10, 10)
        base = rco.refine(model, data)
        fitted = fitted_from(base, [data], tolerance=0.0)
        library = rco.effect_library(model)
        kept = in_race(fitted, library, (0.0, 1.0))
        places = {e.place for e in kept if e.kind == "cubic_stiffness"}
        assert "link4" in places
        assert len(places) <= 6
        channels = [e for e in library if e.place in ("force", "f1", *model.linear.output_labels)]
        assert set(channels) <= set(kept)

    def test_few_places_all_stay(self):
        model = rco.mass_spring_damper([1.0, 1.0], [0.1, 0.1], [100.0, 100.0], sensors=[("velocity", 2)])
        rng = np.random.default_rng(0)
        blank = rco.Measurement(rng.standard_normal(400), np.zeros(400), dt=0.05)
        y = rco.simulate(model, blank, "zero").outputs[0]
        data = rco.Measurement(blank.inputs, y + 0.1 * y.std() * rng.standard_normal(400), dt=0.05)
        fitted = fitted_from(rco.refine(model, data), [data], tolerance=0.0)
        library = rco.effect_library(model)
        assert in_race(fitted, library, (0.0,)) == library
