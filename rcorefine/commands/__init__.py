"""Tasks of the command `rcorefine`, one file per task."""

#: Examples of `rcorefine example`, the default first. Defined here, so that the command starts at once.
EXAMPLES = (
    "mass_spring_damper", "state_space", "mechanical", "series_rlc", "dc_motor", "two_tanks",
    "thermal_network", "quarter_car",
)  # fmt: skip
