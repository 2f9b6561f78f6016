# Lab 6, solved. Goes on from the blocks of the lab's text.
# Before: - m g l phi^3 / 6 + m g l phi^5 / 120 = -0.82 phi^3 + 0.041 phi^5 for 0.5 m. 1 % at 0.24 rad and
# at 1.05 rad. A cubic fitted to large angles is smaller in size, for the fifth power pulls the other way.
import math

# Step 1
found = rco.diagnose(model, quiet, candidates=laws)
print(found)
assert found.verdict == "adequate"
shown = next(d for d in found.detectable if d.effect.kind == "cubic_stiffness")
assert shown.smallest > 9.81 * length / 6  # it is there, and this record could not show it

# Step 2
found = rco.diagnose(model, medium, candidates=laws)
print(found)
assert found.best.effect.kind == "cubic_stiffness"
cubic = found.best.coefficients["cubic_stiffness"]
assert abs(cubic / (-9.81 * length / 6) - 1) < 0.1

# Step 3
found = rco.diagnose(model, loud, candidates=laws)
print(found)
assert found.verdict == "unexplained"
tabulated = rco.refine(model, loud, [found.law()])
assert rco.compare(tabulated, loud).fit > 97
found.hidden_force.plot()


# Step 4
def swing(t, x, u, params):
    weight = 9.81 * params["l"] * np.sin(x[0])
    return np.array([x[1], (u[0] - params["c"] * x[1] - weight) / params["l"] ** 2])


def angle(t, x, u, params):
    return x[:1]


whole = ct.nlsys(
    swing, angle, params={"l": length, "c": 0.1}, name="whole", states=["angle", "rate"], inputs=["torque"],
    outputs=["angle"],
)  # fmt: skip
for record in (quiet, medium, loud):
    left = rco.compare(whole, record).rmse
    assert abs(float(np.ravel(left)[0]) - 0.005) < 0.0005  # the noise of the encoder

# Step 5: it softens: the larger the swing, the slower
better = rco.refine(model, medium, [rco.Effect("cubic_stiffness", "pivot")])
better.bode_plot(levels=[0.05, 0.2, 0.4])
print(f"cubic {cubic:.3f}, -m g l / 6 = {-9.81 * length / 6:.3f}; rms angles", [
    round(math.sqrt(float((r.outputs**2).mean())), 2) for r in (quiet, medium, loud)
])  # fmt: skip
