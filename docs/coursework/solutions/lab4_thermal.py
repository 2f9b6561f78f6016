# Lab 4, solved. Goes on from the blocks of the lab's text.
# Before: 40 K. With a T^2 the loss has the slope 1/R_a + 2 a T: slower near 0. A linear model with a
# smaller R_a fits one step well, and is wrong at 25 %.

# Step 1
print(rco.compare(model, step))
seeming = step.outputs[0, -50:].mean() / 2.0  # K/W: 20 for the linear model
assert seeming < 20

# Step 2: the law is likelier than any offset of the heater
found = rco.diagnose(model, step)
print(found)
assert found.best.effect == rco.Effect("quadratic_damping", "heater-ambient")
assert found.best.fit_after > found.best.fit_before + 10

# Step 3
linear = rco.refine(model, step, free="linear", tolerance=0.5, offset=False)
quarter = measured(np.r_[np.zeros(20), 25.0 * np.ones(380)])
end = {
    "linear": rco.simulate(linear, quarter, "zero").outputs[0, -1],
    "measured": quarter.outputs[0, -50:].mean(),
}

# Step 4: a new level every minute
rng = np.random.default_rng(student)
data = measured(np.repeat(rng.choice([0.0, 20.0, 40.0, 60.0, 80.0, 100.0], 20), 30))
found = rco.diagnose(model, data)
print(found)
assert found.verdict == "effect"
assert found.best.effect == rco.Effect("quadratic_damping", "heater-ambient")
better = found.refine()
end["right"] = rco.simulate(better, quarter, "zero").outputs[0, -1]
assert abs(end["right"] - end["measured"]) < 0.3 < abs(end["linear"] - end["measured"])
a = found.best.coefficients["quadratic_damping"]
T = step.outputs[0, -50:].mean()
assert abs(1 / seeming - (1 / 20 + a * T)) < 0.003  # step 1, explained

# Step 5
print(rco.check(model, data))
print(f"a = {a:.6f} W/K^2; at 25 %: {end}")
