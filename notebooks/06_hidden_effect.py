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
# # 6. A hidden effect: which one, where, and how sure
#
# Three masses hang between two walls on four springs and dampers. A random force drives the first mass, and
# one sensor measures its velocity. The model lacks exactly one effect, somewhere. The cell below that
# simulates the record contains it.
#
# The steps: measure the misfit of the model, diagnose what is missing, add it, and validate.

# %%
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import rcorefine as rco

plt.rcParams.update({"figure.dpi": 90})
m, c, k = [1.0, 1.2, 0.8], [0.25, 0.25, 0.25, 0.25], [300.0, 250.0, 200.0, 150.0]
model = rco.mass_spring_damper(m, c, k, force=1, sensors=[("velocity", 1)])
print(model)

# %% [markdown]
# ## The record
#
# 3000 samples at 100 Hz, with 3 % sensor noise. scipy integrates the equations, not rcorefine.


# %%
def record(gain=1.0, seed=3, samples=3000, dt=0.01):
    """Measured force and velocity of the structure with its secret."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(samples)
    force = gain * 20 * np.convolve(rng.standard_normal(samples + 4), np.ones(5) / 5, "valid")
    system = model.system

    def motion(time, x):
        rate = system.A @ x + system.B[:, 0] * np.interp(time, t, force)
        between = x[1] - x[0]  # masses 1 and 2 are positions 0 and 1, velocities 3 and 4
        hidden = 600.0 * between**3 / 0.3  # the secret
        return rate + hidden * np.array([0, 0, 0, 1 / m[0], -1 / m[1], 0])

    x = solve_ivp(motion, (0, t[-1]), np.zeros(6), t_eval=t, max_step=dt, rtol=1e-6, atol=1e-9).y
    y = system.C[0] @ x
    noisy = y + 0.03 * y.std() * rng.standard_normal(samples)
    return rco.Measurement(force, noisy, dt=dt, hold="foh", input_labels=["force"], name="shaker test")


data = record()
before = rco.compare(model, data)
print(before)

# %% [markdown]
# The model does not explain a part of the motion. Is it noise, or an effect in the structure?
#
# ## What is missing?
#
# Eight effects at each of four links: 32 candidates. `diagnose` first tests the residual. It then compares
# all candidates on the motion estimated from the record, and refits the most probable ones. The best
# candidate must pass the residual tests that the model failed.

# %%
laws = ["stiffness", "damping", "cubic_stiffness", "quadratic_stiffness"]
laws += ["bilinear_stiffness", "coulomb_friction", "quadratic_damping", "cubic_damping"]
candidates = [rco.Effect(law, f"link{i}") for i in range(1, 5) for law in laws]
found = rco.diagnose(model, data, candidates=candidates)
print(found)

# %% [markdown]
# ## The evidence
#
# Top left: the error that remains after each candidate is refitted. Top right: the force at the place of the
# best candidate against the motion there. A smoother estimated the points *without* a force law; the line is
# the force law of the best candidate. The points need not agree with it. Bottom: the remaining residual, in
# time and in frequency.

# %%
found.plot()
plt.show()

# %% [markdown]
# ## Refine and validate
#
# The refined model contains the effect. On a second, unused record with 1.5 times the force, it must be
# better than the initial model.

# %%
better = found.refine()
print(better)
fresh = record(gain=1.5, seed=4)
after = rco.compare([model, better], fresh)
print(after)

# %% [markdown]
# One question remains: is it *this* force law, or one that is only similar at this amplitude? Two records of
# different amplitude answer it: a force law that only imitates the true one would need another coefficient.

# %%
both = rco.diagnose(model, [data, fresh], candidates=candidates)
for sentence in both.sentences():
    print("-", sentence)

# %%
secret = ("cubic_stiffness", "link2")
assert (both.best.effect.kind, both.best.effect.place) == secret
assert abs(both.best.coefficients["cubic_stiffness"] - 2000.0) < 4 * both.best.std["cubic_stiffness"]

# %% [markdown]
# The hidden effect was a hardening spring between masses 1 and 2, with 2000 N/m^3. The motion of mass 2 was
# not measured.
