"""Plants of the exercises, one for each lab.

Each has a linear model, an excitation, and effects that the model may lack.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import control as ct
import numpy as np

from rcorefine import (
    Effect,
    Measurement,
    PhysicalModel,
    dc_motor,
    effect_library,
    mass_spring_damper,
    mechanical,
    physical,
    series_rlc,
    thermal_network,
)

from ..arguments import Array


@dataclass(frozen=True, slots=True)
class ExercisePlant:
    """A linear model, how it is excited, and what it may lack.

    Attributes
    ----------
    make : callable
        The model.
    laws : mapping of str to tuple of str
        Kinds of effects by place.
    dt, amplitude, mean : float
        Sampling time [s]; size and mean of the steps of the input, in its unit.
    hold : int
        Samples between steps.
    """

    make: Callable[[], PhysicalModel]
    laws: Mapping[str, tuple[str, ...]]
    dt: float
    amplitude: float
    hold: int = 1
    mean: float = 0.0

    def candidates(self, model: PhysicalModel) -> tuple[Effect, ...]:
        """Return the effects that may be missing, place by place."""
        return tuple(
            effect
            for place, kinds in self.laws.items()
            for effect in effect_library(model, kinds=kinds, places=place)
        )

    def excited(self, model: PhysicalModel, samples: int, rng: np.random.Generator) -> Measurement:
        """A record with random steps at the input, and nothing measured yet."""
        steps = rng.standard_normal((model.linear.n_inputs, -(-samples // self.hold)))
        inputs = self.mean + self.amplitude * np.repeat(steps, self.hold, axis=1)[:, :samples]
        return record_of(model, inputs, dt=self.dt)


def _rc_circuit() -> PhysicalModel:
    return series_rlc(1000.0, 1e-3, 1e-6, sensors=["capacitor_voltage", "current"], name="rc_circuit")


def _motor() -> PhysicalModel:
    return dc_motor(gain=3.0, time_constant=0.2, name="motor")


def _servo() -> PhysicalModel:
    return dc_motor(gain=3.0, time_constant=0.2, sensors=["angle", "speed"], name="servo")


def _thermal() -> PhysicalModel:
    return thermal_network(
        [8.0, 1.0],
        {(1, 0): 12.0, (1, 2): 20.0},
        ambient_input=False,
        states=["heater", "sensor"],
        inputs="power",
        name="thermal",
    )


def _car() -> PhysicalModel:
    speed, mass, drag = 24.0, 1200.0, 40.0  # m/s, kg, N s/m
    system = ct.ss(
        [[-drag / mass]],
        [[1 / mass]],
        [[1.0]],
        0,
        inputs=["force"],
        outputs=["speed"],
        states=["v"],
        name="car",
    )
    return physical(
        system,
        units={"force": "N", "speed": "m/s", "v": "m/s"},
        parameters={"m": ("mass", "v", mass), "b": ("damping", "v", drag)},
        operating_point={"inputs": drag * speed, "states": {"v": speed}, "outputs": speed},
    )


def _pendulum() -> PhysicalModel:
    length, mass = 0.5, 1.0
    return mechanical(
        [[mass * length**2]],
        [[0.1]],
        [[mass * 9.81 * length]],
        links={"pivot": (1, 0)},
        inputs="torque",
        outputs="angle",
        states=["angle", "rate"],
        position_unit="rad",
        force_unit="N m",
        name="pendulum",
    )


def _crane() -> PhysicalModel:
    """Return a crane: a cart on a spring with a hanging load.

    The coordinates are those of the cart, and the offset of the load.
    """
    cart, load, length = 2.0, 0.5, 0.6
    mass = np.array([[cart + load, load], [load, load]])
    return mechanical(
        mass,
        np.diag([3.0, 0.05]),
        np.diag([60.0, load * 9.81 / length]),
        links={"rail": (1, 0), "hinge": (2, 0)},
        sensors=[("displacement", 1), ("displacement", 2)],
        name="crane",
    )


def _frame() -> PhysicalModel:
    return mass_spring_damper(
        [2.0, 2.0, 1.5],
        [1.5, 1.2, 1.0],
        [900.0, 800.0, 600.0],
        sensors=[("displacement", 1), ("displacement", 3)],
        name="frame",
    )


_DAMPERS = ("damping", "quadratic_damping", "coulomb_friction")
_INPUT = ("input_gain", "input_deadzone", "input_delay")

PLANTS: Mapping[str, ExercisePlant] = {
    "rc_circuit": ExercisePlant(
        _rc_circuit,
        {
            "resistor": ("damping", "coulomb_friction", "cubic_damping"),
            "capacitor": ("stiffness", "cubic_stiffness", "bilinear_stiffness"),
            "voltage": ("input_gain", "input_deadzone"),
        },
        1e-4, 5.0, hold=5,
    ),
    "motor": ExercisePlant(_motor, {"shaft": (*_DAMPERS, "mass"), "voltage": _INPUT}, 0.01, 6.0, hold=15),
    "servo": ExercisePlant(_servo, {"shaft": _DAMPERS, "voltage": _INPUT}, 0.01, 6.0, hold=12),
    "thermal": ExercisePlant(
        _thermal,
        {
            "heater-ambient": ("damping", "quadratic_damping", "cubic_damping"),
            "heater-sensor": ("damping", "quadratic_damping"),
            "sensor": ("mass",),
            "power": ("input_gain", "input_delay"),
        },
        2.0, 1.0, hold=25, mean=3.0,
    ),
    "car": ExercisePlant(
        _car,
        {
            "v": ("damping", "quadratic_damping", "cubic_damping"),
            "force": ("input_gain", "input_delay", "input_lag"),
        },
        0.1, 900.0, hold=20, mean=960.0,
    ),
    "pendulum": ExercisePlant(
        _pendulum,
        {
            "pivot": ("stiffness", "cubic_stiffness", "bilinear_stiffness", *_DAMPERS),
            "torque": ("input_gain", "input_delay"),
        },
        0.02, 1.5, hold=10,
    ),
    "crane": ExercisePlant(
        _crane,
        {place: ("stiffness", "cubic_stiffness", *_DAMPERS) for place in ("rail", "hinge")},
        0.02, 15.0, hold=8,
    ),
    "frame": ExercisePlant(
        _frame,
        {
            f"link{i}": ("stiffness", "damping", "cubic_stiffness", "bilinear_stiffness", "coulomb_friction")
            for i in (1, 2, 3)
        },
        0.01, 40.0, hold=3,
    ),
}  # fmt: skip


def record_of(
    model: PhysicalModel, inputs: Array, outputs: Array | None = None, *, dt: float, name: str = "record"
) -> Measurement:
    """Return a record with the labels and units of the model.

    The inputs have shape (n_w, N), the outputs (n_y, N); by default they are zero.
    """
    linear = model.linear
    return Measurement(
        inputs,
        np.zeros((linear.n_outputs, np.shape(inputs)[-1])) if outputs is None else outputs,
        dt=dt,
        input_labels=linear.input_labels,
        output_labels=linear.output_labels,
        input_units=model.input_units or None,
        output_units=model.output_units or None,
        name=name,
    )
