# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 9. Free decays: a pendulum and a ship
#
# Many laboratories release a system and record its decay. Such a record has no input. This notebook finds
# what a linear model of a pendulum lacks. It then analyzes a ship model that was released in roll.
#
# The ship record is public (MIT license, Martin Alexandersson; model tests by SSPA). Put `rolldecay.csv` into
# a folder and name the folder in the environment variable `RCOREFINE_DATA`. Without it this part is skipped.

# %%
import os
import warnings
from pathlib import Path

import control as ct
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import rcorefine as rco

plt.rcParams.update({"figure.dpi": 80})

# %% [markdown]
# ## The pendulum
#
# The linear model holds for small angles, and its bearing has viscous friction only. The true pendulum swings
# to 50 degrees, and its bearing also has Coulomb (dry) friction.

# %%
model = ct.ss(
    [[0, 1], [-25, -0.1]], [[0], [1]], [[1, 0]], 0,
    inputs="torque", outputs="theta", states=["theta", "omega"], name="pendulum",
)  # fmt: skip


def released(angle, seed, n=900, dt=0.02):
    """A release from rest, with a sensor noise of 0.5 mrad."""

    def rates(t, x):
        return [x[1], -25 * np.sin(x[0]) - 0.1 * x[1] - 0.12 * np.tanh(x[1] / 1e-3)]

    t = np.arange(n) * dt
    run = solve_ivp(rates, (0, t[-1]), [np.radians(angle), 0], t_eval=t, max_step=0.005)
    noisy = run.y[0] + 5e-4 * np.random.default_rng(seed).standard_normal(n)
    return rco.Measurement.free_decay(noisy, dt=dt, output_labels="theta", output_units="rad")


data = released(50, seed=1)
compared = rco.compare(model, data)
print(compared)
shown = compared.plot("decay")

# %% [markdown]
# The picture shows two things. First, the measured amplitudes bend down on the logarithmic axis. Coulomb
# friction takes the same amount from each half cycle, so the damping ratio grows as the amplitude falls.
# Second, the frequency depends on the amplitude: the restoring torque grows less than the angle.

# %%
steps = rco.improve(model, data)
print(steps.diagnosis)

# %% [markdown]
# The diagnosis, that of `diagnose`, names both effects: Coulomb friction, and gravity, whose torque follows
# the sine of the angle. `improve` adds them one by one and validates them on the last part of the motion. A
# second release from another angle must give the same coefficients.

# %%
print(steps)
better = steps.refinement
print(rco.confirm(better, [data, released(30, seed=2)]))
shown = rco.compare([model, better], data).plot("decay")

# %% [markdown]
# ## The ship
#
# The model is a mass on a spring with linear damping. Ship hydrodynamics predicts a part of the damping that
# grows with the amplitude.

# %%
path = Path(os.environ.get("RCOREFINE_DATA", ".")) / "rolldecay.csv"
if path.is_file():
    t, phi = np.loadtxt(path, delimiter=",", skiprows=1).T
    roll = rco.Measurement.free_decay(phi, dt=0.01, output_labels="phi", output_units="rad").decimate(5)
    w, ratio = 2 * np.pi / 2.54, 0.007
    ship = ct.ss(
        [[0, 1], [-(w**2), -2 * ratio * w]], [[0], [1]], [[1, 0]], 0,
        inputs="moment", outputs="phi", states=["phi", "rate"], name="ship",
    )  # fmt: skip
    loose = [rco.Effect("stiffness", "phi"), rco.Effect("damping", "phi")]
    laws = [rco.Effect("quadratic_damping", "phi"), rco.Effect("cubic_stiffness", "phi")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rco.RCOWarning)
        bent = rco.refine(ship, roll, [*loose, *laws])
    print(bent)
    shown = rco.compare([ship, bent], roll).plot("decay")
else:
    print("skipped: rolldecay.csv is not in the folder that RCOREFINE_DATA names")

# %% [markdown]
# The damping ratio rises with the amplitude. The frequency rises, too: the righting moment of this hull grows
# more than the angle. `diagnose` calls the full record *unexplained*, for two reasons. Below 6 degrees the
# damping ratio no longer falls, and a power of the speed fits the rest better than its square. The candidates
# that it lists are pairs of a nonlinear damping and a stiffening spring.
