# Lab 1, solved. Goes on from the blocks of the lab's text.
# Before: q' = (u - q/C) / R, tau = RC = 1 ms, -3 dB at 1000 rad/s. Rs makes tau = (R + Rs) C; the static
# gain to the capacitor stays 1. From the capacitor's voltage alone R C counts, whichever of the two is
# off; the current is u / (R + Rs) at the step, whatever C is.

# Step 1
ideal = ct.ss(
    [[-1 / 1e-3]], [[1e-3]], [[1e6], [-1e3]], [[0.0], [1e-3]],
    inputs="voltage", outputs=["capacitor_voltage", "current"], states=["charge"],
)  # fmt: skip
ct.bode_plot(ideal[0, 0])
before = rco.compare(model, test)
print(before.failures)

# Step 2: either verdict says the same: R + Rs stands where R did. Offered are the laws of linear parts,
# and a diode
series = rco.Effect("damping", "resistor")
found = rco.diagnose(model, train, candidates=offered)
print(found)
assert found.verdict == "parameters" or found.best.effect == series
better = rco.refine(model, train, [series])
print(better)
Rs, std = (getattr(better.parameter("damping"), what) for what in ("coefficient", "std"))

# Step 3: the jump of the current at each step is u / (R + Rs), and the charge has not moved yet
one = rco.series_rlc(1000.0, 1e-5, 1e-6, sensors="capacitor_voltage")
one_data = rco.Measurement(
    train.inputs, train.outputs[0], dt=train.dt, input_labels="voltage", output_labels="capacitor_voltage"
)
alone = rco.refine(one, one_data, [series])
print(alone)
assert alone.parameter("damping").std > 1.5 * std
assert abs(alone.parameter("damping").coefficient - Rs) < 4 * alone.parameter("damping").std

# Step 4: noise of 20 mV and 20 uA under what the test record has
after = rco.compare([model, better], test)
print(after)
after.plot()
after.plot("bode")
reachable = 100 * (1 - np.array([0.02, 2e-5]) / test.outputs.std(axis=1))
assert np.all(after.fit[1] > reachable - 0.1)
print(f"Rs = {Rs:.1f} +- {std:.1f} ohm")
