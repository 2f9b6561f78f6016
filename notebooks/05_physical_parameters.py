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
# # 5. From a wrong model to physical parameters with error bars
#
# Notebook 3 ended with a model that behaves like the damaged structure but does not show which spring is
# damaged. Here the same structure and the same kind of record give the two stiffnesses in N/m, each with an
# error bar. The difference: we specify *what* may have changed (an effect) and *where* (a place).
#
# Four questions:
#
# 1. What are the stiffnesses?
# 2. What does the error bar mean?
# 3. What does it *not* mean?
# 4. What can a record not show, however long it is?

# %%
import warnings

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import rcorefine as rco

plt.rcParams.update({"figure.dpi": 110, "axes.grid": True, "grid.alpha": 0.3, "legend.framealpha": 0.9})
INITIAL, TRUE, REFINED, MEASURED, WRONG = "tab:orange", "0.65", "tab:blue", "0.2", "tab:red"


def structure(k2, k3):
    """Two masses between two walls: three springs and dampers, force and sensor on mass 1."""
    return rco.mass_spring_damper(
        [0.8, 0.5], [100.0, 200.0, 120.0], [1000.0, k2, k3], sensors=("velocity", 1), name="structure"
    )


def measure(model, force, dt, noise, rng, x0="zero"):
    """What a sensor with `noise` (a fraction of its signal) reads."""
    blank = rco.Measurement(force, np.zeros_like(force), dt=dt)
    y = rco.simulate(model, blank, x0).outputs[0]
    return rco.Measurement(force, y + noise * y.std() * rng.standard_normal(y.size), dt=dt)


initial, true = structure(25000.0, 25000.0), structure(1500.0, 2000.0)
print(initial)

# %% [markdown]
# ## 1. What are the stiffnesses?
#
# 5000 samples, 1 ms apart, 1 % noise, one velocity sensor. The springs at `link2` and `link3` are suspected.

# %%
rng = np.random.default_rng(0)
data = measure(true, rng.standard_normal(5000), 1e-3, 0.01, rng)
suspects = [rco.Effect("stiffness", "link2"), rco.Effect("stiffness", "link3")]
result = rco.refine(initial, data, suspects)
result

# %% [markdown]
# The true values are 1500 and 2000 N/m. The initial values were wrong by a factor of 15, and both estimates
# are right within two standard deviations. The refined model is an ordinary `StateSpace`. Its frequency
# response agrees with the measured one; that of the initial model does not.

# %%
cplt = result.bode_plot(data, title="The refined model runs through the measured points")
cplt.figure.set_size_inches(8, 6.5)
plt.show()

# %% [markdown]
# ## 2. What does the error bar mean?
#
# `std` is the standard deviation that the estimate *would show if the experiment were repeated*. We can
# repeat it: 60 new records, each with another force and other noise.

# %%
repeats = []
for seed in range(1, 61):
    rng = np.random.default_rng(seed)
    again = measure(true, rng.standard_normal(5000), 1e-3, 0.01, rng)
    repeats.append(rco.refine(initial, again, suspects))
values = np.array([[row.value for row in r.parameters[:2]] for r in repeats])
stds = np.array([[row.std for row in r.parameters[:2]] for r in repeats])
truth = np.array([1500.0, 2000.0])
inside = np.mean(np.abs(values - truth) < 1.96 * stds, axis=0)

fig, axes = plt.subplots(1, 3, figsize=(11, 3.5), layout="constrained", width_ratios=[1, 1, 1.1])
for ax, i, name in ((axes[0], 0, "k2"), (axes[1], 1, "k3")):
    sd = stds[:, i].mean()
    grid = truth[i] + sd * np.linspace(-4, 4, 200)
    ax.hist(
        values[:, i], bins=truth[i] + sd * np.arange(-4, 4.1, 0.5), density=True, color=REFINED, alpha=0.5
    )
    ax.plot(grid, np.exp(-0.5 * ((grid - truth[i]) / sd) ** 2) / (sd * np.sqrt(2 * np.pi)), color=MEASURED)
    ax.axvline(truth[i], color="black", ls="--", lw=1)
    ax.set(xlabel=f"{name} [N/m]", yticks=[])
    ax.set_title(f"{name}: scatter {values[:, i].std(ddof=1):.1f}, error bar {sd:.1f}", fontsize=10)
axes[0].set_ylabel("share of the 60 records")
ax = axes[2]
ax.plot(*values.T, ".", color=REFINED, label="60 records")
turn = np.linspace(0, 2 * np.pi, 200)
root = np.linalg.cholesky(np.mean([r.covariance[:2, :2] for r in repeats], axis=0))
circle = np.sqrt(5.99) * root @ np.array([np.cos(turn), np.sin(turn)])  # 95 % of two normal numbers
ax.plot(*(truth[:, None] + circle), color=MEASURED, lw=1.2, label="95 % by the covariance")
ax.plot(*truth, "k+", ms=12, label="truth")
ax.set(xlabel="k2 [N/m]", ylabel="k3 [N/m]")
ax.set_title("too stiff in one, too soft in the other", fontsize=10)
ax.legend(loc="upper right", fontsize=8)
fig.suptitle("The error bar of one record (line) foretells the scatter over many (bars, dots)")
plt.show()
print(f"95 % intervals that hold the truth: k2 {inside[0]:.0%}, k3 {inside[1]:.0%}")

# %% [markdown]
# The line was computed from the error bars alone, without the scatter. The two agree, and about 95 of 100
# intervals `row.interval` contain the true value. The errors of the two springs are correlated (right): a
# record that makes one look too stiff makes the other look too soft. `result.covariance` contains this
# correlation.
#
# ## 3. What does it not mean?
#
# The error bar shows how much *another record* would change the estimate. It does not show that the model is
# right. Example: a cart with Coulomb (dry) friction, refined with a model that has viscous friction only:

# %%
dt = 0.02
cart = ct.ss([[0, 1], [0, -2.0]], [[0], [1.0]], [[0, 1]], 0, inputs="force", outputs="v", states=["x", "v"])
rng = np.random.default_rng(4)
force = np.repeat(2.0 * rng.standard_normal(120), 20)
speed, v = np.zeros(force.size), 0.0
for k in range(
    force.size - 1
):  # the truth, in 200 small steps per sample: friction of 0.8 N may stop the cart
    for _ in range(200):
        free = v + dt / 200 * (force[k] - 2.0 * v)
        v = np.sign(free) * max(abs(free) - dt / 200 * 0.8, 0.0)
    speed[k + 1] = v
data = rco.Measurement(force, speed + 0.01 * speed.std() * rng.standard_normal(speed.size), dt=dt)
friction = rco.Effect("coulomb_friction", "x")
viscous = rco.refine(cart, data, [rco.Effect("damping", "x")], offset=False)
right = rco.refine(cart, data, [rco.Effect("damping", "x"), friction], offset=False)
print(viscous, right, sep="\n\n")

# %%
fig, (top, bottom) = plt.subplots(
    2, 1, figsize=(8, 5), sharex=True, layout="constrained", height_ratios=[2, 1]
)
shown = slice(0, 900)
top.plot(data.timepts[shown], data.outputs[0, shown], color=TRUE, lw=5, label="measured")
for r, color, label in ((viscous, WRONG, "viscous only"), (right, REFINED, "viscous + dry")):
    run = r.simulate(data).outputs
    top.plot(
        data.timepts[shown], np.ravel(run)[shown], color=color, lw=1.2, label=f"{label}: fit {r.fit[0]:.0f} %"
    )
    bottom.plot(data.timepts[shown], (data.outputs[0] - np.ravel(run))[shown], color=color, lw=1)
top.set(
    ylabel="velocity [m/s]",
    title="Viscous friction cannot stand still; it imitates dry friction with too much damping",
)
bottom.set(xlabel="time [s]", ylabel="measured - model")
top.legend(loc="upper right", fontsize=8, ncols=3)
plt.show()
row, home = viscous.parameter("damping"), right.parameter("damping")
print(f"viscous only:      c = {row.value:.2f} +- {row.std:.2f} N s/m")
print(f"with dry friction: c = {home.value:.3f} +- {home.std:.3f} N s/m (truth: 2)")

# %% [markdown]
# The estimate is wrong by many standard deviations. The error bar does not show it, but the *fit* and the
# residual do. With the right effect the damping **returns to its true value**. If adding an effect brings
# linear parameters back to their design values, this supports the effect.
#
# ## 4. What can a record not show?
#
# One mass between two springs. We soften the second one and measure the displacement.

# %%
dt = 0.05
one = rco.mass_spring_damper([1.0], [0.3, 0.3], [50.0, 50.0], name="one mass")
damaged = rco.mass_spring_damper([1.0], [0.3, 0.3], [50.0, 30.0])
rng = np.random.default_rng(2)
data = measure(damaged, rng.standard_normal(2000), dt, 0.02, rng)
springs = [rco.Effect("stiffness", "link1"), rco.Effect("stiffness", "link2")]
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    blind = rco.refine(one, data, springs)
print(*(f"{w.category.__name__}: {w.message}" for w in caught), sep="\n")
print()
print(blind)

# %% [markdown]
# Both springs pull the mass in the same way, so the record determines only their sum. `refine` names the
# combination that it cannot estimate and gives it an infinite error bar. The fit is still perfect. More data
# does not help, but prior *knowledge* does: if spring 1 is known to 1 N/m, pass it as a prior.

# %%
known = rco.Effect("stiffness", "link1", start={"stiffness": 0.0}, prior={"stiffness": 1.0})
informed = rco.refine(one, data, [known, springs[1]])
print(informed)

# %%
k1, k2 = np.meshgrid(np.linspace(20, 62, 15), np.linspace(18, 60, 15))
misfit = np.empty_like(k1)
for place in np.ndindex(k1.shape):
    trial = rco.mass_spring_damper([1.0], [0.3, 0.3], [k1[place], k2[place]])
    error = rco.simulate(trial, data, "zero").outputs - data.outputs
    misfit[place] = np.sqrt(np.mean(error**2)) / data.outputs.std()

fig, ax = plt.subplots(figsize=(6.4, 5), layout="constrained")
filled = ax.contourf(k1, k2, 100 * misfit, levels=14, cmap="Greys")
fig.colorbar(filled, label="error / std(y) [%]")
ax.plot([20, 62], [60, 18], color=REFINED, lw=1.5, ls="--", label="k1 + k2 = 80 N/m: all equally good")
a, b = (row for row in informed.parameters[:2])
ax.errorbar(
    a.value,
    b.value,
    xerr=1.96 * a.std,
    yerr=1.96 * b.std,
    fmt="o",
    color=REFINED,
    capsize=3,
    label="with the prior",
)
ax.plot(50, 50, "s", color=INITIAL, label="initial model")
ax.plot(50, 30, "k+", ms=14, mew=2, label="truth")
ax.set(xlabel="k1 [N/m]", ylabel="k2 [N/m]", title="One mass, two springs: a valley, not a pit")
ax.legend(loc="lower left", fontsize=8)
plt.show()

# %% [markdown]
# ## Summary
#
# * Specify what may have changed and where: `refine` returns physical parameters in physical units.
# * `std` is the scatter over repeated records, with colored residuals allowed for.
# * It does not validate the model. Look at the fit and at the residual (`rco.compare`) first.
# * An `IdentifiabilityWarning` names the combination that the record cannot determine. More data of the same
#   kind does not help. A prior, another sensor or another place of the force does.
