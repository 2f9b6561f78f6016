"""The pull of a magnet, i^2 / x^2 over an air gap: a law that feels an input."""

import control as ct
import numpy as np
from scipy.integrate import solve_ivp

import rcorefine as rco
from rcorefine.effects import Coefficient, PortLaw


class MagnetPull(PortLaw):
    """Pull of a magnet at a distance `gap` from rest; the second input is its current."""

    formula = "f = -k i^2 / (gap - d)^2"
    explanation = "A magnet pulls at {place}, by the square of its current over its distance."
    coefficients = (Coefficient("strength", "force position^2/signal^2", explanation="k"),)
    constants = {"gap": 1.0}  # noqa: RUF012

    @staticmethod
    def law(d, w, strength, gap):
        """Resisting force: a pull towards positive d is negative."""
        return -strength * (w[1] / (gap - d)) ** 2


TRUE, GAP = {"strength": 0.3}, 1.0
MODEL = ct.ss(
    [[0, 1], [-20, -0.4]], [[0, 0], [1, 0]], [[1, 0]], [[0, 0]],
    states=["x", "v"], inputs=["force", "current"], outputs=["x"], name="anchor",
)  # fmt: skip


def record(n=1500, dt=0.02):
    """Inputs and displacement of the true system, by scipy."""
    t = dt * np.arange(n)
    noise = np.random.default_rng(3).standard_normal((2, n))
    smooth = np.stack([np.convolve(row, np.ones(9) / 9, "same") for row in noise])
    w = np.stack([3.0 * smooth[0], 2.0 + smooth[1]])

    def rate(now, x):
        force, current = np.interp(now, t, w[0]), np.interp(now, t, w[1])
        pull = TRUE["strength"] * (current / (GAP - x[0])) ** 2
        return x[1], force - 20.0 * x[0] - 0.4 * x[1] + pull

    x = solve_ivp(rate, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=dt).y
    return rco.Measurement(w, x[0], dt=dt, hold="foh")


def main():
    """Find the strength in the record with 1 % of noise."""
    exact = record()
    noise = 0.01 * exact.outputs.std() * np.random.default_rng(4).standard_normal(exact.outputs.shape)
    data = rco.Measurement(exact.inputs, exact.outputs + noise, dt=exact.dt, hold="foh")
    return rco.refine(MODEL, data, [rco.Effect("custom", "x", law=MagnetPull, fixed={"gap": GAP})])


if __name__ == "__main__":
    print(main())
