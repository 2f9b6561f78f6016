"""A drag with an exponent of its own, f = c v |v|^(p - 1), found in a record of a mass on a spring."""

import numpy as np
from scipy.integrate import solve_ivp

import rcorefine as rco
from rcorefine.effects import Coefficient, PortLaw, register


@register
class PowerDrag(PortLaw):
    """Drag between laminar (p = 1) and turbulent (p = 2)."""

    where = frozenset({"mechanical", "first_order"})
    formula = "f = c v |v|^(p - 1)"
    explanation = "A drag that grows with a power of the speed acts at {place}."
    coefficients = (
        Coefficient("drag", "force/velocity", lower=0.0, explanation="force at unit speed"),
        Coefficient("power", "1", 1.0, 3.0, default_start=1.8, explanation="exponent", shapes=True),
    )

    @staticmethod
    def law(v, drag, power):
        """Resisting force."""
        return drag * v * abs(v) ** (power - 1.0)


TRUE = {"drag": 1.2, "power": 1.5}
MODEL = rco.mass_spring_damper(1.0, 0.1, 20.0, sensors="velocity")


def record(n=2000, dt=0.02):
    """Input and velocity of the true system, by scipy."""
    t = dt * np.arange(n)
    force = 8.0 * np.convolve(np.random.default_rng(1).standard_normal(n), np.ones(7) / 7, "same")

    def rate(now, x):
        drag = TRUE["drag"] * np.sign(x[1]) * abs(x[1]) ** TRUE["power"]
        return x[1], np.interp(now, t, force) - 20.0 * x[0] - 0.1 * x[1] - drag

    x = solve_ivp(rate, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=dt).y
    return rco.Measurement(force, x[1], dt=dt, hold="foh")


def main():
    """Find the coefficients in the record with 1 % of noise."""
    exact = record()
    noise = 0.01 * exact.outputs.std() * np.random.default_rng(2).standard_normal(exact.outputs.shape)
    data = rco.Measurement(exact.inputs, exact.outputs + noise, dt=exact.dt, hold="foh")
    return rco.refine(MODEL, data, [rco.Effect("power_drag", "mass1")])


if __name__ == "__main__":
    print(main())
