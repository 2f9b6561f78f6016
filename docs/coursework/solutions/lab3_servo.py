# Lab 3, solved. Goes on from the blocks of the lab's text.
# Before: tau v' + v = K (u - U_c sign v); it stands still. The describing function 4 U_c / (pi a) is a
# damper that falls with the amplitude: a linear fit finds 1/K too large, and more so in the small record.

# Step 1
print(rco.compare(model, small), rco.compare(model, large), sep="\n")

# Step 2
fits = [rco.refine(model, data, free="linear", tolerance=0.5) for data in (small, large)]
resistance = [fit.parameter("1/gain").value for fit in fits]
assert resistance[0] > 1.3 * resistance[1] > 1.05 / 3.0
crossed = rco.compare(fits[0], large).fit, rco.compare(fits[1], large).fit
assert np.all(crossed[0] < crossed[1])

# Step 3
print(rco.compare(model, train).failures)
rco.compare(model, train).plot("map")

# Step 4: Stribeck's law contains Coulomb's: with two coefficients more it gains nothing
found = rco.diagnose(model, train, candidates=offered)
print(found)
found.plot()
assert found.verdict == "effect"
assert found.best.effect == rco.Effect("coulomb_friction", "shaft")

# Step 5
better = found.refine()
assert np.all(rco.compare(better, test).fit > rco.compare(model, test).fit)
again = rco.refine(model, small, [found.best.effect])
one, other = better.parameter("coulomb_friction"), again.parameter("coulomb_friction")
assert abs(one.value / other.value - 1) < 0.03  # the linear fits differed by more than 30 %
print(f"friction: {one.value:.3f} +- {one.std:.3f} V, from the small record {other.value:.3f}")
