# Lab 5, solved. Goes on from the blocks of the lab's text.
# Before: F0 = b v0 + c v0^2; slope b + 2 c v0. Time constants 30 s and about 18 s. About 24 m/s c v^2 is
# mostly a damper of 2 c v0; c (dv)^2 of the deviation alone has no slope at all.

# Step 2: what looks missing is the slope, a damper
above = train.deviation(F0, v0)
linear = rco.diagnose(plain, above)
print(linear)
assert linear.best is None or linear.best.effect.kind != "quadratic_damping"

# Step 3: a power law contains the square; damping and cubic damping come near, since the record covers
# few speeds
found = rco.diagnose(car, train)
print(found)
drag = rco.Effect("quadratic_damping", "v")
assert drag in found.ambiguous
better = rco.refine(car, train, [drag])
c, std = (getattr(better.parameter("quadratic_damping"), what) for what in ("coefficient", "std"))
assert abs(c - c0) < 0.02
print(f"speeds {train.outputs.min():.1f} to {train.outputs.max():.1f} m/s")

# Step 4
assert np.all(rco.compare(better, test).fit > rco.compare(car, test).fit + 5)
controller = ct.tf([550.0, 18.0], [1, 0])
times = np.linspace(0, 30, 300)
for plant in (plain, better.system):
    ct.step_response(ct.feedback(plant * controller), times).plot()

law, step = better.nonlinear, 0.1
v, summed, reached = v0, 0.0, []
for _ in times:
    error = 34.0 - v
    summed += step * error
    force = F0 + 550.0 * error + 18.0 * summed
    v += step * float(law.dynamics(0.0, np.array([v]), np.array([force]))[0])
    reached.append(v)
late = np.argmax(np.array(reached) > 24 + 9) * 0.1
promised = np.argmax(ct.step_response(ct.feedback(plain * controller), times).outputs > 0.9) * 0.1
print(
    f"c = {c:.4f} +- {std:.4f}, from the balance {c0:.4f}; 90 % after {late:.1f} s, promised {promised:.1f} s"
)
assert late > promised
