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
# one sensor reads its velocity. The model is right but for one thing, somewhere. The record below was made
# with it, and the cell that made it is the only one that knows.
#
# The way: look at what the model misses, ask what could be missing, add it, and look again.

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
# 3000 samples at 100 Hz, with 3 % sensor noise. The equations are integrated by scipy, not by rcorefine.


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
# The model misses a part of the motion. Is that noise, or something in the structure?
#
# ## What is missing?
#
# Eight laws at each of four links: 32 candidates. `diagnose` tests the residual, scores every candidate on
# the motion that the record itself shows, refits the best of them in free run, and lets the winner pass the
# same tests that the model failed.

# %%
laws = ["stiffness", "damping", "cubic_stiffness", "quadratic_stiffness"]
laws += ["bilinear_stiffness", "coulomb_friction", "quadratic_damping", "cubic_damping"]
candidates = [rco.Effect(law, f"link{i}") for i in range(1, 5) for law in laws]
found = rco.diagnose(model, data, candidates=candidates)
print(found)

# %% [markdown]
# ## The evidence
#
# Top left: how much each rival still misses after its own refit. Top right: the force at the winning place,
# estimated by a smoother that was told *no* law, against the motion there. The line is the law that won;
# the points did not have to lie on it. Bottom: what is left, in time and in frequency.

# %%
found.plot()
plt.show()

# %% [markdown]
# ## Refine, and look again
#
# The refined model holds the effect. On a second record, half as strong again and used for nothing so far,
# it must be better than the model that we began with.

# %%
better = found.refine()
print(better)
fresh = record(gain=1.5, seed=4)
after = rco.compare([model, better], fresh)
print(after)

# %% [markdown]
# One question is left: is it *this* law, or one that only looks like it at this amplitude? Two records of
# different strength answer that: a law that merely mimics the true one would need another coefficient.

# %%
both = rco.diagnose(model, [data, fresh], candidates=candidates)
for sentence in both.sentences():
    print("-", sentence)

# %%
secret = ("cubic_stiffness", "link2")
assert (both.best.effect.kind, both.best.effect.place) == secret
assert abs(both.best.coefficients["cubic_stiffness"] - 2000.0) < 4 * both.best.std["cubic_stiffness"]

# %% [markdown]
# The secret was a hardening spring between masses 1 and 2, with 2000 N/m^3. The sensor never saw mass 2.
