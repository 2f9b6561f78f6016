# Lab 7, solved. Goes on from the blocks of the lab's text.
# Before: K[1, 1] = -m g l = -0.98. A mode grows with e^(4.9 t): 1 mm is 20 m after 2 s. Noise reaches the
# input one sample later: what is predicted one sample ahead does not depend on the noise that is still to
# come.

# Step 1: without friction the cart comes to rest at its place; with it, it hunts about it
loop = ct.feedback(
    ct.ss(model.system.A, model.system.B, np.eye(4), 0), ct.ss([], [], [], gains.reshape(1, 4))
)
ideal = ct.forced_response(ct.ss(loop.A, loop.B @ gains[:1].reshape(1, 1), loop.C, 0), data.timepts, wanted)
hunting = np.std((data.outputs[0] - ideal.outputs[0])[500:])
assert hunting > 0.005

# Step 2
print(rco.check(model, data))
before = rco.compare(model, data)
assert before.led

# Step 3
found = rco.diagnose(model, data)
print(found)
assert found.verdict == "effect"
assert found.best.effect == rco.Effect("coulomb_friction", "mass1")
friction, std = found.best.coefficients["force"], found.best.std["force"]
found.plot()

# Step 4: the controller takes most of the friction away: position follows the reference nearly as without
outer = rco.Measurement(wanted, data.outputs[0], dt=0.01)
closed = ct.ss(loop.A, loop.B @ gains[:1].reshape(1, 1), loop.C[:1], 0)
print(rco.compare(closed, outer))

# Step 5: F = -K x + F_c sign(v): with the other sign friction is doubled, with too much of the right one
# the cart pushes itself
print(f"friction {friction:.3f} +- {std:.4f} N")
