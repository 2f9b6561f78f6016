# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 10. A measured pendulum: which effect holds for the small swing, too?
#
# A pendulum arm was released by hand six times, from 22 to 93 degrees, and its angle was recorded at 100 Hz.
# The model is linear. This notebook finds what it lacks from the largest swing and tests the result on a
# smaller one.
#
# The data are public (MIT license, Copyright (c) 2022 dynamicslab, multi-arm pendulum); the license stands
# beside them in `pendulum_releases.LICENSE`.

# %%
import warnings

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import rcorefine as rco

plt.rcParams.update({"figure.dpi": 80})
table = np.genfromtxt("pendulum_releases.csv", delimiter=",", names=True)


def release(name):
    """One release: a record without an input."""
    angle = table[f"{name}_rad"]
    return rco.Measurement.free_decay(
        angle[np.isfinite(angle)], dt=0.01, release=0, output_labels="angle", output_units="rad", name=name
    )


large, small = release("train1"), release("test1")

# %% [markdown]
# ## The linear model
#
# The arm has a mass of 0.15 kg at 0.15 m. The model has the torque of the weight as a spring, m g l times the
# angle, and a small viscous friction.

# %%
m, length = 0.15, 0.15
inertia = m * length**2 + 1e-4
model = ct.ss(
    [[0, 1], [-m * 9.81 * length / inertia, -1e-4 / inertia]], [[0], [1 / inertia]], [[1, 0]], 0,
    states=["angle", "rate"], inputs=["torque"], outputs=["angle"], name="pendulum",
)  # fmt: skip
compared = rco.compare(model, large)
print(compared)
shown = compared.plot("decay")

# %% [markdown]
# The frequency depends on the amplitude, so the simulation soon gets out of step with the measurement.
#
# ## What is missing
#
# Several effects bend the torque at large angles: gravity (the sine of the angle), a cubic spring, a
# clearance. `diagnose` fits them to the first part of the decay, chooses on the next part, where the swing is
# smaller, and tests on the last part.

# %%
found = rco.diagnose(model, large)
print(found)

# %% [markdown]
# It names gravity. The residual is not noise: with 917 samples and hardly any sensor noise, the tests find an
# error of less than 0.1 % of the motion. That is too small to matter here, and the text says so. Only
# ratios are known: in a free decay, all torques and the inertia may be scaled alike.
#
# `improve` comes to the same effect.

# %%
steps = rco.improve(model, large)
print(steps)

# %% [markdown]
# ## Another amplitude
#
# The model was fitted to the swing from 93 degrees. The release from 32 degrees was not used.

# %%
better = steps.refinement
for name, one in (("linear", model), ("with gravity", better)):
    print(f"{name:13s} {1e3 * rco.compare(one, small).rmse[0]:6.1f} mrad")
shown = rco.compare([model, better], small).plot()

# %% [markdown]
# An effect that only imitates gravity fits the large swing as well, and fails here: a soft clearance with
# three coefficients.

# %%
with warnings.catch_warnings():
    warnings.simplefilter("ignore", rco.RCOWarning)
    mimic = rco.refine(model, large, [rco.Effect("soft_clearance", "angle")], free="linear")
    gravity = rco.refine(model, large, [rco.Effect("gravity", "angle", fixed={"tangent": 0})], free="linear")
for name, one in (("soft clearance", mimic), ("gravity", gravity)):
    errors = [1e3 * rco.compare(one, data).rmse[0] for data in (large, small)]
    print(f"{name:15s} fitted {errors[0]:5.1f} mrad, 32 degrees {errors[1]:6.1f} mrad")
