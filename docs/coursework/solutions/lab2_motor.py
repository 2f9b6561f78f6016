# Lab 2, solved. Goes on from the blocks of the lab's text.
# Before: K from the end, tau from the first 3 tau, about 60 to 80 samples of 600. Steps up and down:
# every change tells tau anew.

# Step 1
print(rco.compare(model, step), rco.compare(model, prbs), sep="\n")
K_hand = step.outputs[0, 300:].mean() / 6.0
tau_hand = 0.01 * np.argmax(step.outputs[0] > 0.632 * 6.0 * K_hand)

# Step 2: inertia, friction and the offset of the input act alike while the motor only ever goes up; a
# second of rest before the step would show the offset alone.
poor = rco.refine(model, step, free="linear", tolerance=0.5)
print(poor)

# Step 3
good = rco.refine(model, prbs, free="linear", tolerance=0.5)
print(good)
better_by = poor.parameter("1/gain").std / good.parameter("1/gain").std
assert better_by > 20
K = 1 / good.parameter("1/gain").value
tau = K * good.parameter("tau/gain").value
assert abs(K / K_hand - 1) < 0.02
assert abs(tau / tau_hand - 1) < 0.1
halves = [
    rco.refine(model, part, free="linear", tolerance=0.5).parameter("1/gain") for part in prbs.split(0.5)
]
spread = np.hypot(halves[0].std, halves[1].std)
assert abs(halves[0].value - halves[1].value) < 4 * spread

# Step 4
found = rco.diagnose(model, prbs)
print(found)
assert found.verdict == "parameters"
plant = found.refine().system
controller = ct.tf([0.5, 2.5], [1, 0])
times = np.linspace(0, 2, 200)
for motor in (model.system, plant):
    ct.step_response(ct.feedback(motor * controller), times).plot()

# Step 5
refiner = rco.RCORefiner(model.system, dt=0.01)
refiner.update(prbs.inputs, prbs.outputs)
assert abs(ct.dcgain(refiner.system) / K - 1) < 0.01
print(
    f"K = {K:.3f} rad/s per volt, tau = {tau:.4f} s; {better_by:.0f} times the standard deviation from a step"
)
