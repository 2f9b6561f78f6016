"""Play in an actuator: what acts follows the command only after a gap. A law with an inner state."""

import numpy as np
from scipy.integrate import solve_ivp

import rcorefine as rco
from rcorefine.effects import Coefficient, InputLaw, register


@register
class ActuatorPlay(InputLaw):
    """Backlash: inside the gap nothing moves on."""

    formula = "r follows w with play of +- gap"
    explanation = "The input {place} has play: it acts again only a gap after it has turned."
    coefficients = (
        Coefficient("gap", "signal", lower=0.0, default_start=None, explanation="half play", shapes=True),
    )

    @staticmethod
    def law(w, z_start, gap):
        """What acts, which is also what is remembered."""
        r = min(max(z_start, w - gap), w + gap)
        return r, r

    def starts(self, seen):
        """Gaps in shares of the command."""
        return [{"gap": float(q)} for q in np.quantile(np.abs(seen.signal), (0.1, 0.3, 0.6))]


TRUE = {"gap": 0.7}
MODEL = rco.mass_spring_damper(1.0, 0.4, 20.0)


def record(n=2000, dt=0.02):
    """Command and displacement of the true system, by scipy."""
    t = dt * np.arange(n)
    w = 3.0 * np.sin(1.3 * t) + 2.0 * np.sin(2.9 * t + 1.0)
    fine = np.linspace(0.0, t[-1], 16 * (n - 1) + 1)  # it may turn or catch between two samples
    acts = np.interp(fine, t, w)
    last = 0.0
    for k, command in enumerate(acts):
        acts[k] = last = np.clip(last, command - TRUE["gap"], command + TRUE["gap"])

    def rate(now, x):
        return x[1], np.interp(now, fine, acts) - 20.0 * x[0] - 0.4 * x[1]

    x = solve_ivp(rate, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=dt).y
    return rco.Measurement(w, x[0], dt=dt, hold="foh")


def main():
    """Find the gap in the record with 1 % of noise."""
    exact = record()
    noise = 0.01 * exact.outputs.std() * np.random.default_rng(6).standard_normal(exact.outputs.shape)
    data = rco.Measurement(exact.inputs, exact.outputs + noise, dt=exact.dt, hold="foh")
    return rco.refine(MODEL, data, [rco.Effect("actuator_play", "force")])


if __name__ == "__main__":
    print(main())
