# Lab 8, solved. Goes on from the blocks of the lab's text.
# Before: a frequency falls by half the loss times the share of strain energy: at most 5 % for a loss of
# 10 %. Three frequencies have three shifts, one pattern for each storey; noise and temperature blur it.
frequencies = np.sort(np.unique(ct.damp(model.system, doprint=False)[0].round(3)))

# Step 1
assert not any(row.named for row in rco.localize_damage(model, healthy).rows)
print(rco.compare(model, healthy))

# Step 2
measured = [record.frequency_response().frd for record in (healthy, data)]
ct.FrequencyResponseList([ct.frequency_response(model.system, measured[0].omega), *measured]).plot()

# Step 3
found = rco.localize_damage(model, data)
print(found)
found.plot()
named = [row for row in found.rows if row.named]
assert len(named) == 1
assert named[0].kind == "stiffness"

# Step 4
small = rco.mass_spring_damper(
    [2.0, 2.0, 1.5], [1.5, 1.2, 1.0], [900.0, 800.0, 600.0], sensors=[("velocity", 1)], name="frame"
)
first = rco.Measurement(data.inputs, data.outputs[0], dt=0.01, input_labels="force", output_labels="v1")
alone = rco.localize_damage(small, first)
brief = rco.localize_damage(small, first.segment(0.0, 2.0))
print(alone, brief, sep="\n")

# Step 5
candidates = [rco.Effect("stiffness", f"link{i}") for i in (1, 2, 3)]
monitor = rco.Monitor(model, candidates, dt=0.01, learn=1500)
monitor.update(healthy.inputs, healthy.outputs)
assert monitor.alarm is None
monitor.update(data.inputs, data.outputs)
print(monitor.alarm)
assert monitor.alarm is not None
print(frequencies, named[0])
