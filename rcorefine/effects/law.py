"""The catalogue of effects: laws, coefficients, units, bounds, words.

Sign convention at a port: f is the resisting force, so a positive
coefficient means more resistance (stiffness, damping, friction), and damage is
negative.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import MappingProxyType

__all__ = ["KINDS", "Coefficient", "Kind"]


@dataclass(frozen=True, slots=True)
class Coefficient:
    """One number of an effect, to be estimated.

    Parameters
    ----------
    name : str
        Name, as in ``start={"stiffness": 10.0}``.
    unit_rule : str
        Unit in terms of ``force``, ``position``, ``velocity`` (of the port),
        ``signal`` (of the channel) and ``s``; see `combine_units`.
    lower, upper : float
        Bounds that physics sets, infinite where it sets none.
    default_start : float or None
        Value to start an estimate from; None where it must be found from data,
        because the error does not feel the coefficient there or has
        several valleys.
    explanation : str
        What the number means.
    """

    name: str
    unit_rule: str
    lower: float = -inf
    upper: float = inf
    default_start: float | None = 0.0
    explanation: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """A law that can be missing from a model.

    Parameters
    ----------
    name : str
        Name, as in ``Effect("coulomb_friction", "link2")``.
    where : frozenset of str
        Kinds of places: ``"mechanical"``, ``"first_order"`` (ports),
        ``"input"``, ``"output"`` (channels), ``"any"`` (an entry of A for
        `coefficient`, any port for `custom`).
    coefficients : tuple of Coefficient
        Numbers to estimate.
    constants : mapping
        Names of numbers that are never estimated, with their default; None is
        chosen from the data. They can be set through ``Effect(..., fixed=...)``.
    linear : bool
        Whether the refined model stays linear with constant coefficients.
    formula : str
        Law in symbols: f force, d displacement, v velocity, w input, y output.
    explanation : str
        One sentence, with ``{place}`` for the place.
    explanation_first_order : str
        The same at a first-order port, if it reads differently.
    needs : frozenset of str
        What the port must sense: ``"position"``, ``"velocity"``.
    inner_states : int
        Number of states that the effect itself has.
    order : tuple of (str, str)
        Pairs of coefficients of which the first is never below the second.
    """

    name: str
    where: frozenset[str]
    coefficients: tuple[Coefficient, ...]
    constants: Mapping[str, float | None]
    linear: bool
    formula: str
    explanation: str
    explanation_first_order: str = ""
    needs: frozenset[str] = frozenset()
    inner_states: int = 0
    order: tuple[tuple[str, str], ...] = ()

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the coefficients, in order."""
        return tuple(coefficient.name for coefficient in self.coefficients)

    def coefficient(self, name: str) -> Coefficient:
        """Coefficient of the given name (KeyError if there is none)."""
        for coefficient in self.coefficients:
            if coefficient.name == name:
                return coefficient
        raise KeyError(f"kind {self.name!r} has no coefficient {name!r}, only {self.coefficient_names}")

    def __reduce__(self) -> tuple[object, tuple[str]]:
        # the catalogue is fixed, so a name says it all (mapping proxies do not pickle)
        return (_kind, (self.name,))


def _kind(name: str) -> Kind:
    return KINDS[name]


def _make(
    name: str,
    where: str,
    coefficients: tuple[Coefficient, ...],
    formula: str,
    explanation: str,
    *,
    first_order: str = "",
    linear: bool = False,
    needs: str = "",
    inner_states: int = 0,
    constants: Mapping[str, float | None] | None = None,
    order: tuple[tuple[str, str], ...] = (),
) -> Kind:
    return Kind(
        name=name,
        where=frozenset(where.split()),
        coefficients=coefficients,
        constants=MappingProxyType(dict(constants or {})),
        linear=linear,
        formula=formula,
        explanation=explanation,
        explanation_first_order=first_order,
        needs=frozenset(needs.split()),
        inner_states=inner_states,
        order=order,
    )


# the width over which sign(v) is smoothed: fixed, because a free one only fits noise
_WIDTH = {"width": None}
_C = Coefficient

_STIFFNESS = (
    _make(
        "stiffness", "mechanical", (_C("stiffness", "force/position", explanation="change of stiffness"),),
        "f = t d",
        "The spring at {place} is stiffer than the model says (softer, as by a crack, if negative).",
        linear=True, needs="position",
    ),
    _make(
        "cubic_stiffness", "mechanical",
        (_C("cubic_stiffness", "force/position^3", explanation="force per cubed displacement"),),
        "f = t d^3",
        "The spring at {place} hardens as it is pushed either way (softens, if negative).",
        needs="position",
    ),
    _make(
        "quadratic_stiffness", "mechanical",
        (_C("quadratic_stiffness", "force/position^2", explanation="force per squared displacement"),),
        "f = t d^2",
        "The spring at {place} is stiffer on one side than on the other, more so the further it is moved.",
        needs="position",
    ),
    _make(
        "bilinear_stiffness", "mechanical",
        (_C("bilinear_stiffness", "force/position", explanation="stiffness added where d > 0"),),
        "f = t max(d, 0)",
        "The spring at {place} has another stiffness in one direction, like a crack that opens and closes.",
        needs="position",
    ),
    _make(
        "clearance", "mechanical",
        (
            _C("stiffness", "force/position", explanation="stiffness of the contact"),
            _C("gap", "position", lower=0.0, default_start=None, explanation="play on either side"),
        ),
        "f = t sgn(d) max(|d| - gap, 0)",
        "There is play at {place}: a stop is hit once the displacement exceeds a gap.",
        needs="position",
    ),
)  # fmt: skip

_DAMPING = (
    _make(
        "damping", "mechanical first_order",
        (_C("damping", "force/velocity", explanation="change of damping"),),
        "f = t v",
        "The damping at {place} is larger than the model says (smaller, if negative).",
        first_order="The loss or flow in proportion to the state at {place} is larger than the model says "
        "(smaller, if negative).",
        linear=True, needs="velocity",
    ),
    _make(
        "coulomb_friction", "mechanical first_order",
        (_C("force", "force", explanation="friction force, whatever the speed"),),
        "f = t sgn(v)",
        "Dry friction acts at {place}: a force of constant size that opposes the motion.",
        first_order="A loss of constant size acts at {place}, with the sign of the state, like dry friction.",
        needs="velocity", constants=_WIDTH,
    ),
    _make(
        "asymmetric_friction", "mechanical",
        (
            _C("force_plus", "force", explanation="friction force where v > 0"),
            _C("force_minus", "force", explanation="friction force where v < 0 (positive = resistance)"),
        ),
        "f = t+ where v > 0, -t- where v < 0",
        "Dry friction at {place} differs between the two directions of motion, like a worn screw.",
        needs="velocity", constants=_WIDTH,
    ),
    _make(
        "asymmetric_damping", "mechanical",
        (
            _C("damping_plus", "force/velocity", explanation="damping where v > 0"),
            _C("damping_minus", "force/velocity", explanation="damping where v < 0"),
        ),
        "f = t+ v where v > 0, t- v where v < 0",
        "The damping at {place} differs between the two directions of motion, like a car's shock absorber.",
        needs="velocity",
    ),
    _make(
        "stribeck_friction", "mechanical",
        (
            _C("coulomb_force", "force", lower=0.0, explanation="friction force at high speed"),
            _C("static_force", "force", lower=0.0, explanation="friction force at breakaway"),
            _C("velocity", "velocity", lower=0.0, default_start=None,
               explanation="speed at which the static part has faded"),
        ),
        "f = sgn(v) (Fc + (Fs - Fc) exp(-(v/vs)^2))",
        "Dry friction at {place} is at least as high at breakaway as in motion; any excess fades with speed "
        "(stick and slip).",
        needs="velocity", constants=_WIDTH, order=(("static_force", "coulomb_force"),),
    ),
    _make(
        "quadratic_damping", "mechanical first_order",
        (_C("quadratic_damping", "force/velocity^2", explanation="force per squared velocity"),),
        "f = t v |v|",
        "A drag that grows with the square of the speed acts at {place}, as in air, water or a valve.",
        first_order="A loss that grows with the square of the state acts at {place}.",
        needs="velocity",
    ),
    _make(
        "cubic_damping", "mechanical first_order",
        (_C("cubic_damping", "force/velocity^3", explanation="force per cubed velocity"),),
        "f = t v^3",
        "The damping at {place} grows with the cube of the speed.",
        first_order="A loss that grows with the cube of the state acts at {place}.",
        needs="velocity",
    ),
    _make(
        "hysteresis", "mechanical",
        (
            _C("force", "force", explanation="force that the hysteresis saturates at"),
            _C("displacement", "position", lower=0.0, default_start=None,
               explanation="presliding displacement: how far it gives before it slips"),
        ),
        "f = t z/D, dz/dt = v - |v| z/D (Dahl)",
        "The force at {place} depends on the path taken: a joint that gives a little before it slips.",
        needs="position velocity", inner_states=1,
    ),
)  # fmt: skip

_OTHER = (
    _make(
        "mass", "mechanical first_order",
        (_C("mass", "force s/velocity", explanation="added mass"),),
        "f = t dv/dt",
        "The moving mass at {place} is larger than the model says (smaller, if negative).",
        first_order="The storage (capacity, area) at {place} is larger than the model says "
        "(smaller, if negative).",
        linear=True, needs="velocity",
    ),
    _make(
        "hidden_mode", "mechanical",
        (
            _C("mass", "force s/velocity", lower=0.0, default_start=None, explanation="attached mass"),
            _C("damping", "force/velocity", lower=0.0, default_start=None, explanation="its damper"),
            _C("stiffness", "force/position", lower=0.0, default_start=None, explanation="its spring"),
        ),
        "m z'' = f = c (v - z') + k (d - z)",
        "Something is attached at {place} and vibrates on its own spring: "
        "a mass, spring and damper that the model lacks.",
        linear=True, needs="velocity", inner_states=2,
    ),
    _make(
        "constant_force", "mechanical first_order",
        (_C("force", "force", explanation="constant resisting force"),),
        "f = t",
        "A constant force acts at {place}: weight, preload or a tilted base.",
        first_order="A constant loss (a gain, if negative) acts at {place}: a leak, a heater or an offset.",
    ),
    _make(
        "sqrt_flow", "first_order",
        (_C("flow", "force/velocity^0.5", explanation="flow per root of the state"),),
        "f = t sqrt(max(x, 0))",
        "The outflow at {place} follows the square root of the level, as through an orifice (Torricelli).",
        needs="velocity",
    ),
    _make(
        "threshold_flow", "first_order",
        (
            _C("flow", "force/velocity", explanation="flow per unit above the threshold"),
            _C("threshold", "velocity", default_start=None, explanation="level at which it starts"),
        ),
        "f = t max(x - threshold, 0)",
        "Beyond a certain level something spills over at {place}.",
        needs="velocity",
    ),
    _make(
        "coefficient", "any",
        (_C("value", "entry", explanation="change of the entry"),),
        "dx_i/dt = ... + t x_j",
        "The entry {place} of the state matrix differs from the model's.",
        linear=True,
    ),
)  # fmt: skip

_INPUT = (
    _make(
        "input_gain", "input", (_C("gain", "1", explanation="relative change of the gain"),),
        "w -> (1 + t) w",
        "The input {place} acts more strongly than the model says (less, if negative).",
        linear=True,
    ),
    _make(
        "input_offset", "input", (_C("offset", "signal", explanation="constant added to the input"),),
        "w -> w + t",
        "The input {place} has an offset: a constant is added before it acts.",
    ),
    _make(
        "input_delay", "input",
        (_C("delay", "s", lower=0.0, default_start=None, explanation="dead time"),),
        "w(t) -> w(t - delay)",
        "The input {place} acts later than the record says: a dead time.",
        linear=True,
    ),
    _make(
        "input_lag", "input",
        (_C("time_constant", "s", lower=0.0, default_start=None, explanation="time constant"),),
        "T dr/dt + r = w, w -> r",
        "The input {place} does not act at once but catches up with a lag, like a slow actuator.",
        linear=True, inner_states=1,
    ),
    _make(
        "input_deadzone", "input",
        (_C("threshold", "signal", lower=0.0, default_start=None, explanation="input that is lost"),),
        "w -> sgn(w) max(|w| - threshold, 0)",
        "The input {place} has a dead zone: small values do nothing, and larger ones lose that much.",
    ),
    _make(
        "input_saturation", "input",
        (_C("limit", "signal", lower=0.0, default_start=None, explanation="largest size that acts"),),
        "w -> min(max(w, -limit), limit)",
        "The input {place} saturates: it cannot exceed a limit in either direction.",
    ),
)  # fmt: skip

_OUTPUT = (
    _make(
        "output_gain", "output", (_C("gain", "1", explanation="relative change of the gain"),),
        "y -> (1 + t) y",
        "The sensor {place} reads larger than the model says (smaller, if negative).",
        linear=True,
    ),
    _make(
        "output_offset", "output", (_C("offset", "signal", explanation="constant added to the output"),),
        "y -> y + t",
        "The sensor {place} has an offset: a constant is added to what it measures.",
    ),
    _make(
        "output_delay", "output",
        (_C("delay", "s", lower=0.0, default_start=None, explanation="dead time"),),
        "y(t) -> y(t - delay)",
        "The sensor {place} reports late: a dead time.",
        linear=True,
    ),
    _make(
        "output_lag", "output",
        (_C("time_constant", "s", lower=0.0, default_start=None, explanation="time constant"),),
        "T dr/dt + r = y, y -> r",
        "The sensor {place} is slow: it follows what it measures with a lag, like a filter.",
        linear=True, inner_states=1,
    ),
    _make(
        "output_saturation", "output",
        (_C("limit", "signal", lower=0.0, default_start=None, explanation="largest size it can show"),),
        "y -> min(max(y, -limit), limit)",
        "The sensor {place} is capped: beyond a limit it shows the limit.",
    ),
    _make(
        "output_rectification", "output",
        (_C("fraction", "1", lower=0.0, upper=1.0, default_start=None, explanation="rectified share"),),
        "y -> (1 - t) y + t |y|",
        "The sensor {place} loses the sign: it shows the size, in whole (1) or in part.",
    ),
)  # fmt: skip

_CUSTOM = _make(
    "custom", "mechanical first_order any", (_C("scale", "force", explanation="scale of the law"),),
    "f = t law(d, v)",
    "A law of your own acts at {place}.",
)  # fmt: skip

KINDS: Mapping[str, Kind] = MappingProxyType(
    {kind.name: kind for kind in (*_STIFFNESS, *_DAMPING, *_OTHER, *_INPUT, *_OUTPUT, _CUSTOM)}
)
"""All kinds of effect by name, in the order in which they are listed to people."""
