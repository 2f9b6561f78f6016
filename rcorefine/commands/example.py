"""Command `rcorefine example`: write a model file and a record.

The other commands accept both files as they are.
"""

from __future__ import annotations

import io
import sys
import textwrap
from argparse import ArgumentTypeError
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import rcorefine as rco

from ..writing import replacing


@dataclass(frozen=True, slots=True)
class _Example:
    """A model file, the effect that its record hides, and how it is excited."""

    toml: str
    kind: str
    place: str
    values: tuple[float, ...]
    dt: float
    amplitude: float
    hold: int = 1
    mean: float = 0.0
    smooth: dict[str, float] = field(default_factory=dict)


_EXAMPLES = {
    "mass_spring_damper": _Example(
        """\
# A chain on springs and dampers: ground, link1, mass 1, link2, mass 2.
[mass_spring_damper]
m = [1.0, 0.8]              # masses [kg]
c = [0.5, 0.4]              # dampers [N s/m]
k = [200.0, 150.0]          # springs [N/m]
sensors = ["velocity", 1]   # or "displacement"; several: [["velocity", 1], ...]
# excitation = "base"       # shaken at its base instead of pushed
# force = 1                 # the mass that the force acts on
# inputs = ["force"]        # names, which the columns of the record should have
# outputs = ["v1"]
""",
        "coulomb_friction", "link2", (1.0,), 0.01, 10.0, smooth={"width": 1e-3},
    ),
    "state_space": _Example(
        """\
# Matrices: dx/dt = A x + B u, y = C x + D u. Where the states have physical
# units, rcorefine finds the places in them.
[state_space]
A = [[0.0, 1.0], [-100.0, -0.4]]
B = [[0.0], [1.0]]          # or [0.0, 1.0] for one input
C = [[1.0, 0.0]]
D = [[0.0]]                 # may be left out
dt = 0                      # 0: continuous time; else the sampling time in s
inputs = ["force"]
outputs = ["position"]
states = ["x", "v"]
name = "oscillator"
""",
        "cubic_stiffness", "x", (200.0,), 0.02, 10.0,
    ),
    "mechanical": _Example(
        """\
# Mass and stiffness matrices, damping ratios of the modes.
[mechanical]
M = [[2.0, 0.0], [0.0, 1.0]]
K = [[300.0, -100.0], [-100.0, 100.0]]
damping_ratio = [0.02, 0.02]
force_map = 1
sensors = [["displacement", 1], ["displacement", 2]]
links = { foot = [1, 0], middle = [1, 2] }
""",
        "stiffness", "middle", (-15.0,), 0.02, 10.0,
    ),
    "series_rlc": _Example(
        """\
# A resistor, an inductor and a capacitor in series, driven by a voltage.
[series_rlc]
R = 250.0                   # [Ohm]
L = 0.055                   # [H]
C = 23.5e-6                 # [F]
sensors = "resistor_voltage"
""",
        "input_gain", "voltage", (-0.1,), 1e-4, 1.0,
    ),
    "dc_motor": _Example(
        """\
# A motor by its parts; or gain and time_constant in place of R, L, Kt and J.
[dc_motor]
R = 1.2                     # [Ohm]
L = 2e-3                    # [H]
Kt = 0.06                   # [N m/A]
J = 4e-5                    # [kg m^2]
b = 1e-5                    # [N m s/rad]
sensors = ["speed"]
""",
        "coulomb_friction", "shaft", (0.02,), 0.002, 6.0, hold=20, smooth={"width": 1e-2},
    ),
    "two_tanks": _Example(
        """\
# Two tanks, one above the other; the level of the lower one is measured.
[two_tanks]
areas = [2.0, 1.0]          # [m^2]
outflows = [0.5, 0.4]       # [m^2/s]
pump_gain = 1.0             # [m^3/(s V)]
sensors = [1, 2]
""",
        "damping", "tank2", (0.1,), 0.2, 0.5, hold=10, mean=1.0,
    ),
    "thermal_network": _Example(
        """\
# Heat capacities and the resistances between them; node 0 is the surroundings.
[thermal_network]
capacities = [10.0, 20.0]   # [J/K]
resistances = { "1-2" = 0.5, "2-0" = 2.0 }  # [K/W]
heat = [1]
ambient_input = false
""",
        "damping", "T1", (0.1,), 0.5, 5.0, hold=8, mean=5.0,
    ),
    "quarter_car": _Example(
        """\
# A wheel and the body above it, on a road.
[quarter_car]
body_mass = 250.0           # [kg]
wheel_mass = 35.0           # [kg]
suspension_stiffness = 16e3  # [N/m]
suspension_damping = 1e3    # [N s/m]
tire_stiffness = 160e3      # [N/m]
sensors = ["body_acceleration", "suspension_deflection"]
""",
        "asymmetric_damping", "suspension", (-300.0, 600.0), 0.005, 0.5,
    ),
}  # fmt: skip

EXAMPLES = tuple(_EXAMPLES)
_SAMPLES = 2500
_NOISE = 0.02
_SHOWN = 6


def example_toml(name: str) -> str:
    """Model file of an example.

    Parameters
    ----------
    name : str
        One of `EXAMPLES`.

    Returns
    -------
    str
        TOML.
    """
    return _EXAMPLES[name].toml


def example_csv(name: str, *, seed: int = 1, exact: bool = False) -> str:
    """Record of an example, simulated with an effect that its model lacks.

    Parameters
    ----------
    name : str
        One of `EXAMPLES`.
    seed : int
        Of excitation and noise (2 % of each output).
    exact : bool
        Without the effect.

    Returns
    -------
    str
        CSV with a header line: time, inputs, outputs.
    """
    made = _EXAMPLES[name]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.toml"
        path.write_text(made.toml, encoding="utf-8")
        model = rco.physical(rco.read_model(path))
    linear = model.linear
    # random steps at the inputs
    rng = np.random.default_rng(seed)
    steps = rng.standard_normal((linear.n_inputs, -(-_SAMPLES // made.hold)))
    w = made.mean + made.amplitude * np.repeat(steps, made.hold, axis=1)[:, :_SAMPLES]
    # outputs with the hidden effect, and noise that is the same with and without it
    effect = rco.Effect(made.kind, made.place)
    hidden = effect.replace(fixed=dict(zip(effect.coefficients, made.values, strict=True)) | made.smooth)
    blank = rco.Measurement(w, np.zeros((linear.n_outputs, _SAMPLES)), dt=made.dt)
    y = rco.simulate(model, blank, "zero", effects=[] if exact else [hidden]).outputs
    y = y + _NOISE * y.std(axis=1, keepdims=True) * np.random.default_rng([seed, 1]).standard_normal(y.shape)
    text = io.StringIO()
    header = ",".join(["time", *linear.input_labels, *linear.output_labels])
    rows = np.column_stack([blank.timepts, *w, *y])
    np.savetxt(text, rows, fmt="%.9g", delimiter=",", header=header, comments="")
    return text.getvalue()


def example(
    name: str = "mass_spring_damper",
    /,
    *,
    write: Path | None = None,
    seed: int = 1,
    exact: bool = False,
) -> int:
    """Print an example of a model file and of a record, or write both.

    The record contains an effect that is missing in the model, so compare and diagnose end with exit code 1.

    Parameters
    ----------
    name : str
        One of mass_spring_damper, state_space, mechanical, series_rlc, dc_motor, two_tanks,
        thermal_network, quarter_car.
    write : Path, optional
        Write NAME.toml and NAME.csv into this folder.
    seed : int
        Seed of the record.
    exact : bool
        A record without a missing effect, so that the model is adequate.

    Returns
    -------
    int
        0.

    Raises
    ------
    FileExistsError
        If a file is there already; nothing is written then.
    """
    if name not in EXAMPLES:
        raise ArgumentTypeError(f"argument NAME: {name!r} is not one of {', '.join(EXAMPLES)}")
    toml = example_toml(name)
    csv = example_csv(name, seed=seed, exact=exact)
    folder = Path() if write is None else write
    model, record = folder / f"{name}.toml", folder / f"{name}.csv"
    commands = "".join(f"rcorefine {word} {model} {record}\n" for word in ("compare", "diagnose", "improve"))
    if write is not None:
        for path in (model, record):
            if path.exists():
                raise FileExistsError(f"{path} exists; choose another folder or remove it")
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(model) as first, replacing(record) as second:  # both, or none
            first.write(toml.encode())
            second.write(csv.encode())
        sys.stdout.write(f"{model}\n{record}\n\nTry:\n{commands}")
        return 0
    head = "".join(csv.splitlines(keepends=True)[:_SHOWN])
    others = f"Other examples: {', '.join(other for other in EXAMPLES if other != name)}."
    others = textwrap.fill(others, 80, initial_indent="# ", subsequent_indent="#   ")
    sys.stdout.write(
        f"# {model}\n{toml}\n# {record} (the first lines of {_SAMPLES + 1})\n{head}...\n\n"
        f"# rcorefine example {name} --write . makes both files, whole. Then:\n{commands}"
        f"{others}\n"
    )
    return 0
