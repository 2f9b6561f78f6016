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
# # 7. Measured records: a circuit and a positioning drive
#
# The true systems behind these two records are unknown. Both are public benchmarks (nonlinearbenchmark.org):
# the *Silverbox*, a circuit that behaves like a mass on a hardening spring, and *EMPS*, a positioning drive
# with Coulomb (dry) friction. Each starts from a linear model that follows from physics. `improve` finds what
# is missing, and validates the result on held-out data.
#
# Put `SNLS80mV.mat` and `DATA_EMPS.mat` into a folder and name it in the environment variable
# `RCOREFINE_DATA`. If a file is absent, its part is skipped with a message.

# %%
import os
import warnings
from pathlib import Path

import control as ct
import matplotlib.pyplot as plt
import numpy as np
from scipy.io import loadmat
from scipy.signal import resample

import rcorefine as rco

plt.rcParams.update({"figure.dpi": 80})
folder = os.environ.get("RCOREFINE_DATA")


def records(name):
    """The arrays of a file, or None where it is absent."""
    if folder is None:
        print(f"skipped: RCOREFINE_DATA names no folder, so there is no {name}")
        return None
    if not (Path(folder) / name).is_file():
        print(f"skipped: {name} is not in the folder that RCOREFINE_DATA names")
        return None
    return {key: np.ravel(value) for key, value in loadmat(Path(folder) / name).items() if key[0] != "_"}


def climb(model, train, test, **options):
    """The ladder, every linear parameter free; short pieces of a record excite little, which is no news."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rco.RCOWarning)
        return rco.improve(model, train, validation=test, free="linear", **options)


# %% [markdown]
# ## What happens between the samples?
#
# A record contains the input at its samples only. The picture shows the same samples with the three holds of
# rcorefine:

# %%
t = np.arange(24)
u = resample(np.random.default_rng(5).standard_normal(12), 24)
fig, ax = plt.subplots(figsize=(8, 2.8), layout="constrained")
ax.step(t, u, where="post", label="zoh: held", color="0.6")
ax.plot(t, u, "--", label="foh: straight lines", color="tab:orange")
ax.plot(np.arange(24 * 16) / 16, resample(u, 24 * 16), label="band-limited", color="tab:blue")
ax.plot(t, u, "k.", label="samples")
ax.set(xlabel="time [samples]", ylabel="input", xlim=(2, 20), title="One set of samples, three inputs")
ax.legend(ncols=4, fontsize=8, loc="lower center")
plt.show()

# %% [markdown]
# ## The Silverbox
#
# $\ddot y + 41.8\,\dot y + 1.84\cdot 10^5 y = 1.94\cdot 10^5 u$ describes the circuit. The initial model here
# has these parameters 20 % too large. The hold of the input between the samples is also unknown. It is part
# of the model: with a wrong hold, half a sample of delay masks the hardening spring. `improve` tries the
# three holds before it ranks any effect.
#
# The multisine part of the record has 87 000 samples. To save time, 2500 are used for the fit and 2000 later
# ones for validation, and only springs and dampers are candidates. `benchmarks/real_ladders.py` uses all
# samples and all effects.

# %%
silverbox = records("SNLS80mV.mat")
if silverbox is not None:
    off = 1.2
    circuit = ct.ss(
        [[0, 1], [-1.84e5 * off, -41.8 * off]],
        [[0], [1.94e5 * off]],
        [[1, 0]],
        0,
        inputs="V1",
        outputs="V2",
        states=["x", "v"],
        name="silverbox",
    )

    def part(first, last):
        u, y = silverbox["V1"][first:last], silverbox["V2"][first:last]
        labels = {"input_labels": "V1", "output_labels": "V2", "output_units": "V", "name": "silverbox"}
        return rco.Measurement(u, y, dt=1 / 610.35, **labels)

    train, test = part(41000, 43500), part(106000, 108000)
    kinds = ("cubic_stiffness", "quadratic_stiffness", "clearance", "cubic_damping", "coulomb_friction")
    ladder = climb(circuit, train, test, max_effects=1, candidates=[rco.Effect(kind, "x") for kind in kinds])
    print(ladder)

# %%
if silverbox is not None:
    ladder.plot(title="Silverbox: error of the free run on samples kept apart")
    plt.show()

# %% [markdown]
# The errors of both models under each hold: on the held-out samples, and on the *arrow*, another experiment
# of the same authors. Its amplitude grows beyond that of all data above.

# %%
if silverbox is not None:
    print(f"{'hold':14s}{'linear':>22s}{'with the effect':>22s}   [mV]: multisine, arrow")
    for hold in ("zoh", "foh", "bandlimited"):
        line = f"{hold:14s}"
        for effects in ([], list(ladder.effects)):
            fitted = rco.refine(circuit, train.with_hold(hold), effects, free="linear")
            found = []
            for data in (test.with_hold(hold), part(100, 40575).with_hold(hold)):
                residual = rco.simulate(fitted, data).outputs - data.outputs
                found.append(1e3 * np.sqrt(np.mean(residual[0, 50:] ** 2)))
            line += f"{found[0]:12.2f}{found[1]:10.2f}"
        print(line)

# %% [markdown]
# Published results, from models with many more parameters: 0.30 to 0.36 mV on the multisine, 0.26 mV on the
# arrow.
#
# ## The positioning drive
#
# $M\ddot q + F_v\dot q = \tau$ with the published mass and viscous friction. The drive integrates, so a
# simulation of the whole record drifts with the smallest error of the force. Validation therefore uses short
# windows. The first 60 % are used for the fit, the rest for validation. To save time: 100 samples per second,
# friction and dampers as candidates, one added effect.

# %%
emps = records("DATA_EMPS.mat")
if emps is not None:
    force = emps["gtau"][0] * emps["vir"]
    n = force.size // 10 * 10
    held, position = force[:n].reshape(-1, 10).mean(axis=1), emps["qm"][:n:10]
    names = {"input_labels": "force", "output_labels": "q", "input_units": "N", "output_units": "m"}
    cut = int(0.6 * held.size)
    train = rco.Measurement(held[:cut], position[:cut], dt=1e-2, name="EMPS", **names)
    test = rco.Measurement(held[cut:], position[cut:], dt=1e-2, name="EMPS", **names)
    mass, viscous = 95.11, 203.5
    drive = ct.ss(
        [[0, 1], [0, -viscous / mass]],
        [[0], [1 / mass]],
        [[1, 0]],
        0,
        inputs="force",
        outputs="q",
        states=["q", "v"],
        name="EMPS",
    )
    kinds = (
        "coulomb_friction",
        "asymmetric_friction",
        "stribeck_friction",
        "quadratic_damping",
        "asymmetric_damping",
    )
    climbed = climb(drive, train, test, max_effects=1, candidates=[rco.Effect(kind, "q") for kind in kinds])
    print(climbed)

# %%
if emps is not None:
    climbed.plot(title="EMPS: error in windows, on the part kept apart")
    plt.show()

# %% [markdown]
# The errors of each step: in windows of one second on the held-out data, started at the measured position and
# speed, and in one simulation of the whole record. The published error of the latter is 2.64 mm. A row "tied
# with" lists the effects that the data cannot distinguish from the added one. Here, friction that differs by
# direction equals Coulomb friction plus a constant force, and every fit includes a constant force.

# %%
if emps is not None:
    speed = np.gradient(test.outputs[0], test.dt)
    whole = rco.Measurement(held, position, dt=1e-2, **names)
    for step in climbed.steps:
        errors = []
        for first in range(0, test.n_samples - 100 + 1, 100):
            window = slice(first, first + 100)
            data = rco.Measurement(test.inputs[:, window], test.outputs[:, window], dt=test.dt, **names)
            # states that an effect brings with it start at rest
            start = np.zeros(step.refinement.physical_model.linear.n_states)
            start[:2] = test.outputs[0, first], speed[first]
            errors.append(rco.simulate(step.refinement, data, start).outputs - data.outputs)
        drift = rco.simulate(step.refinement, whole).outputs - whole.outputs
        label = "linear model" if step.effect is None else f"{step.action} {step.effect.label}"
        windows, all_ = (1e3 * np.sqrt(np.mean(np.square(e))) for e in (errors, drift))
        print(f"{label:36s}{windows:8.2f} mm in windows{all_:8.2f} mm in one run")
        if step.rivals:
            print("    tied with " + ", ".join(effect.label for effect in step.rivals))

# %% [markdown]
# ## Summary
#
# * Determine the hold first. The test is cheap, and a wrong hold looks like a physical effect.
# * A linear fit imitates what is missing: with the effects added, the linear parameters return toward their
#   physical values.
# * On measured records *unexplained* is the usual verdict: with thousands of samples of low noise, some
#   residual test is significant. The error on held-out data shows whether it matters.
