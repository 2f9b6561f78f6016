"""Base class of laws: words, coefficients, and interface to the package.

Sign convention at a port: f is the resisting force, so a positive coefficient means more resistance
(stiffness, damping, friction), and damage is negative.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from math import inf
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array


class Seen(Protocol):
    """Properties of a record at a place, for initial guesses of coefficients."""

    dt: float

    @property
    def signal(self) -> Array:
        """Record of the channel, shape (N,)."""

    @property
    def d(self) -> Array:
        """Displacement at the port."""

    @property
    def v(self) -> Array:
        """Velocity at the port."""

    @property
    def peaks(self) -> Array:
        """Frequencies [rad/s] of the highest peaks of the output residuals."""

    @property
    def lag(self) -> float:
        """Lag [s] of the outputs behind the simulation, in whole samples."""

    @property
    def drifts(self) -> Sequence[float]:
        """Growth of the lag of the outputs behind the simulation, if seen.

        It is a share of the elapsed time.
        """

    @property
    def pull(self) -> float:
        """Rms force that accelerates the port, 1 where it moves nothing."""

    @property
    def mobility(self) -> float:
        """Largest acceleration per force at the port."""


def rms(signal: Array) -> float:
    """Return the root mean square of a signal."""
    return float(np.sqrt(np.mean(signal**2)))


def at_quantiles(name: str, signal: Array, shares: Sequence[float]) -> list[dict[str, float]]:
    """Return initial guesses of a coefficient at quantiles of a signal."""
    return [{name: float(q)} for q in np.quantile(signal, shares)]


def delays(seen: Seen) -> list[dict[str, float]]:
    """Return initial guesses of a delay.

    From zero delay, a descent does not pass the first minimum of an oscillating signal.
    """
    # a lag seen in the record, then half a sample to six samples
    late = [seen.lag] if seen.lag > 8.0 * seen.dt else []
    return [{"delay": value} for value in [*late, *(q * seen.dt for q in (0.5, 2.5, 6.0))]]


@dataclass(frozen=True, slots=True)
class Coefficient:
    """One number of an effect, to be estimated.

    Parameters
    ----------
    name : str
        Name, as in ``start={"stiffness": 10.0}``.
    unit_rule : str
        Unit in ``force``, ``position``, ``velocity`` (port), ``signal`` (channel), ``s``: `combine_units`.
    lower, upper : float
        Bounds that physics sets, infinite where it sets none.
    default_start : float or None
        Value to start an estimate from; None where it must be found from data, because the error
        does not feel the coefficient there or has several valleys.
    explanation : str
        What the number means.
    shapes : bool
        Whether it gives the law its shape (a gap, a limit) rather than its strength.
    widths : tuple of float
        Bounds in widths of the law (`Law.width_share`), empty for none.
    """

    name: str
    unit_rule: str
    lower: float = -inf
    upper: float = inf
    default_start: float | None = 0.0
    explanation: str = ""
    shapes: bool = False
    widths: tuple[float, ...] = ()


def positive(name: str, unit_rule: str, explanation: str, *, lower: float = 0.0, **more: Any) -> Coefficient:
    """Return a nonnegative coefficient with an initial guess from data."""
    return Coefficient(name, unit_rule, lower, default_start=None, explanation=explanation, **more)


#: Places of a law: stores, or stores and joints.
STORES = frozenset(["first_order"])
PORTS = STORES | {"mechanical"}

#: Constants of a law that acts on one side: where its signal is positive, or negative with side = -1.
ONE_SIDE = MappingProxyType({"side": 1.0})


class Law:
    """A law that can be missing from a model.

    Attributes
    ----------
    name : str
        Name, as in ``Effect("coulomb_friction", "link2")``: that of the class.
    where : frozenset of str
        Kinds of places: ``"mechanical"``, ``"first_order"`` (ports),
        ``"input"``, ``"output"`` (channels), ``"entry"`` (of A or B), ``"any"`` (an entry, or any port).
    coefficients : tuple of Coefficient
        Numbers to estimate.
    constants : mapping
        Names of numbers that are never estimated, with their default; None is
        chosen from the data. ``Effect(..., fixed=...)`` sets them: positive, those in `from_zero` zero too;
        ``side`` (`ONE_SIDE`) is 1 or -1.
    linear : bool
        Whether the refined model stays linear with constant coefficients.
    formula : str
        Law in symbols: f force, d displacement, v velocity, w input, y output.
    explanation : str
        One sentence, with ``{place}`` for the place.
    domains : frozenset of str
        Domains (keys of `DOMAINS`) where people would look for it; empty for all that `where` allows.
    words : tuple of (str, str)
        Name and sentence where the place is no joint of bodies, with the words of `DOMAINS` to fill in:
        ``("quadratic {loss}", "A {loss} that grows with ...")``. Empty where it reads alike everywhere.
    needs : frozenset of str
        What the port must sense: ``"position"``, ``"velocity"``.
    senses : frozenset of str
        What it feels of the port, if that is more: ``"acceleration"`` too.
    inner_states : int
        Number of states that the effect itself has.
    powers : tuple of (str, str)
        Pairs (size, power) of a motion to a power. Fits take the size at the motion that `width_share` is of.
    order : tuple of (str, str)
        Pairs of coefficients of which the first is never below the second.
    belongs_to : str
        Parameter beside which the law is at home: ``"stiffness"``, ``"damping"``, ``"mass"``.
    is_parameter : bool
        Whether it changes a number that linear models have: stiffness, damping, mass, an entry.
    may_wear : bool
        Whether damage changes it first.
    relative : bool
        Whether its coefficient is a share of what the model has.
    inertial : bool
        Whether it adds to what the port moves.
    holds_constant : bool
        Whether it can hold a constant offset.
    on_request : bool
        Whether `effect_library` lists it only where it is asked for by name: far-fetched elsewhere.
    covers : tuple of str
        Linear laws that it contains, which do not float beside it.
    contains : mapping of str to mapping
        Laws that are special cases of it, each with the shape at which it is that law.
    essential : tuple of str
        Coefficients each of which the record must determine for the law to be named: with one of them unknown
        it is another law and a constant, which the unknown start of its own state holds.
    with_offset : str
        Law that it equals together with a constant offset at the place.
    jumps : bool
        Whether the force jumps with the sign of the velocity.
    resists : bool
        Whether it only takes energy, as friction does too (`turns`): its size is positive.
    turns : bool
        Whether it is friction: the force depends on the direction of the motion.
    width_share : float or None
        Width over which a jump or a root is smoothed, as a share of the rms velocity; None for none.
    secant : bool
        Whether its effect is a difference from where it starts: it has no value at which it is absent.
    needs_law : bool
        Whether the user hands over what it is: a function, a table.
    along_motion : bool
        Whether it is a force (or a change of a signal) along a known motion.
    delays : bool
        Whether it shifts its signal in time.
    drifts : tuple of str
        Coefficients that are shares by which the inputs' clock runs ahead of the record's.
    of_record : bool
        Whether it is a fault of the record as a whole, which `diagnose` asks for itself.
    one_signed : bool
        Whether it is looked for only at an input that never changes its sign.
    two_signed : bool
        Whether it is another law of the library where the state never changes its sign.
    both_ways : bool
        Whether it is implausible where a flow has one direction only.
    of_levels : bool
        Whether it is implausible where the state is a difference.
    of_known_stores : bool
        Whether it is implausible at a store whose size the model does not know.
    of_speeds : bool
        Whether it is looked for only at speeds, where the place is a state of its own.
    of_displacements : bool
        Whether it is looked for only at an output that reads a displacement.
    of_differences : str
        Coefficient that is the sample interval where the output is a rate, worked out from differences of
        samples: `diagnose` asks for that itself. "" for none.
    signal : str
        What its coefficient multiplies, where the law is linear in it: ``"displacement"``,
        ``"velocity"``, ``"acceleration"``, ``"value"``, ``"constant"``, ``"rate"``; or what it takes from
        a signal: ``"deadzone"``, ``"saturation"``.
    """

    # name, places, coefficients
    name: ClassVar[str]
    where: ClassVar[frozenset[str]]
    coefficients: tuple[Coefficient, ...]
    constants: ClassVar[Mapping[str, float | None]] = MappingProxyType({})
    from_zero: ClassVar[frozenset[str]] = frozenset()
    linear: ClassVar[bool] = False
    # formula and words
    formula: ClassVar[str]
    explanation: ClassVar[str]
    domains: ClassVar[frozenset[str]] = frozenset()
    words: ClassVar[tuple[str, str]] = ("", "")
    # what it feels of its place, and states of its own
    needs: ClassVar[frozenset[str]] = frozenset()
    senses: ClassVar[frozenset[str]] = frozenset()
    inner_states: ClassVar[int] = 0
    order: ClassVar[tuple[tuple[str, str], ...]] = ()
    powers: ClassVar[tuple[tuple[str, str], ...]] = ()
    # the parameter that it changes
    belongs_to: ClassVar[str] = "damping"
    is_parameter: ClassVar[bool] = False
    may_wear: ClassVar[bool] = False
    relative: ClassVar[bool] = False
    inertial: ClassVar[bool] = False
    holds_constant: ClassVar[bool] = False
    on_request: ClassVar[bool] = False
    # relation to other laws
    covers: ClassVar[tuple[str, ...]] = ()
    contains: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType({})
    essential: ClassVar[tuple[str, ...]] = ()
    with_offset: ClassVar[str] = ""
    # shape of the force
    jumps: ClassVar[bool] = False
    resists: ClassVar[bool] = False
    turns: ClassVar[bool] = False
    width_share: ClassVar[float | None] = None
    # how it enters a simulation
    secant: ClassVar[bool] = False
    needs_law: ClassVar[bool] = False
    along_motion: ClassVar[bool] = True
    delays: ClassVar[bool] = False
    drifts: ClassVar[tuple[str, ...]] = ()
    # where `diagnose` looks for it
    of_record: ClassVar[bool] = False
    one_signed: ClassVar[bool] = False
    two_signed: ClassVar[bool] = False
    both_ways: ClassVar[bool] = False
    of_levels: ClassVar[bool] = False
    of_known_stores: ClassVar[bool] = False
    of_speeds: ClassVar[bool] = False
    of_displacements: ClassVar[bool] = False
    of_differences: ClassVar[str] = ""
    # signal in which it is linear
    signal: ClassVar[str] = ""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # name of the class in lower case: SqrtFlow -> sqrt_flow
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        # it feels no more than it needs, unless the class says so
        if "senses" not in vars(cls):
            cls.senses = cls.needs

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the coefficients, in order."""
        return tuple(coefficient.name for coefficient in self.coefficients)

    @property
    def is_element(self) -> bool:
        """Return whether it changes a spring, a damper or a mass of the model."""
        return self.is_parameter and "mechanical" in self.where

    @property
    def at_channel(self) -> bool:
        """Return whether it acts at an input or an output."""
        return bool(self.where & {"input", "output"})

    def checked(self) -> Law:
        """The law, if its parts fit each other."""
        return self

    def of(self, law: Any, names: tuple[str, ...], label: str) -> Law:
        """Return the law that the user's argument defines.

        This matters for a law that `needs_law`. `names` are the coefficients with an initial guess.
        """
        return self

    @property
    def adjustable(self) -> tuple[str, ...]:
        """Constants that ``Effect(..., fixed=...)`` may set."""
        return tuple(self.constants)

    @property
    def shaping(self) -> frozenset[str]:
        """Names of the coefficients that shape the law."""
        return frozenset(coefficient.name for coefficient in self.coefficients if coefficient.shapes)

    @property
    def special_cases(self) -> frozenset[str]:
        """Names of the laws that it contains, and of those that these contain."""
        # special cases of a special case are special cases too
        held = frozenset(self.contains)
        return held.union(*(_LAWS[name].special_cases for name in held if name in _LAWS))

    def coefficient(self, name: str) -> Coefficient:
        """Coefficient of the given name (KeyError if there is none)."""
        return {coefficient.name: coefficient for coefficient in self.coefficients}[name]

    def starts(self, seen: Seen) -> Sequence[dict[str, float]]:
        """Return initial guesses that the record suggests, the likeliest first.

        Parameters
        ----------
        seen : Seen
            The record at the place.

        Returns
        -------
        sequence of dict
            Coefficients by name; empty where nothing needs a start.
        """
        return []

    def bounds_in(self, structure: Any, place: str) -> tuple[float, float]:
        """Bounds of the coefficients that the model sets at a place."""
        return -inf, inf

    def sits(self, model: Any, place: str) -> bool:
        """Return whether the place is known to this law only.

        Such a place is neither a port nor a channel of the model.
        """
        return False

    def plausible_in_store(self, *, one_way: bool, between: bool, known_mass: bool) -> bool:
        """Return whether the effect is plausible at a first-order port.

        Parameters
        ----------
        one_way : bool
            Whether the port joins two stores and senses one of them alone.
        between : bool
            Whether what it senses is a difference.
        known_mass : bool
            Whether the model knows the size of the store.
        """
        if one_way and self.both_ways:
            return False
        return not (between and self.of_levels) and (known_mass or not self.of_known_stores)

    def push(self, linear: Any, place: str, act: Array | None) -> Array | None:
        """Return the direction in which it drives the states, or None.

        The direction (n,) is that of a constant unit of the effect. None means that it drives no state.

        Parameters
        ----------
        linear : LinearModel
            Model, for the column of an input.
        place : str
            Where it sits.
        act : ndarray, shape (n,), or None
            Of the port.
        """
        return None

    def __reduce__(self) -> tuple[object, tuple[Any, ...]]:
        # laws of the catalogue are pickled by name
        return (_law, (self.name,)) if _LAWS.get(self.name) is self else (instance_of, (type(self),))


_LAWS: dict[str, Law] = {}

KINDS: Mapping[str, Law] = MappingProxyType(_LAWS)
"""All laws by name, in the order in which they are listed to people."""

_Class = TypeVar("_Class", bound=type[Law])


def register(law: _Class) -> _Class:
    """Enter a law into the catalogue.

    Parameters
    ----------
    law : subclass of Law
        Law; its name must be new.

    Returns
    -------
    subclass of Law
        The same.

    Raises
    ------
    ValueError
        If another law has the name.
    """
    # a module that is loaded again replaces its own law
    held = type(_LAWS.get(law.name, law))
    if law.name in _LAWS and (held.__module__, held.__qualname__) != (law.__module__, law.__qualname__):
        raise ValueError(f"there is a law {law.name!r} already: {held.__module__}; give it another name")
    _LAWS[law.name] = instance_of(cast(Any, law))
    return law


@cache
def instance_of(law: Any) -> Law:
    """The law of a class, checked; one in a process."""
    found: Law = law().checked()
    return found


def _law(name: str) -> Law:
    return _LAWS[name]


@dataclass(slots=True, eq=False)
class Assembly:
    """Matrices of the model while the linear effects enter them.

    Attributes
    ----------
    rates : ndarray, shape (n, n + n_w)
        [A, Bu], of which `A` and `Bu` are views.
    A, Bu, inertia, constant : ndarray
        dx/dt = inertia^-1 (A x + Bu r + constant), with r what the inputs become.
    Uw : ndarray, shape (n_w, n_w + 1)
        r = Uw [w; 1].
    output_gain, output_offset : ndarray, shape (n_y,)
    input_lags, output_lags : list of (channel, state, time constant)
    felt : list of ndarray, shape (n_y, 2 n + n_w + 1)
        What sensors read of the forces of effects beside what those do to the states: rows on x, r, 1 and
        dx/dt.
    pace : float or complex
        Time that passes over the time that the record says.
    """

    # state equation: inertia dx/dt = A x + Bu r + constant
    rates: NDArray[Any]
    A: NDArray[Any]
    Bu: NDArray[Any]
    inertia: NDArray[Any]
    constant: NDArray[Any]
    # inputs and outputs
    Uw: NDArray[Any]
    output_gain: NDArray[Any]
    output_offset: NDArray[Any]
    input_lags: list[tuple[int, int, Any]] = field(default_factory=list)
    output_lags: list[tuple[int, int, Any]] = field(default_factory=list)
    felt: list[NDArray[Any]] = field(default_factory=list)
    pace: Any = 1.0

    def force(self, act: NDArray[Any]) -> NDArray[Any]:
        """The force that has entered along `act`, as a row on x, r, 1 and dx/dt."""
        # project what has entered the state equation on the direction of the force
        entered = np.hstack([self.rates, self.constant[:, None], -self.inertia])
        return np.asarray(act @ entered / (act @ act))


@dataclass(frozen=True, eq=False)
class Site:
    """Place of an effect in the states of the model with all effects.

    Attributes
    ----------
    act, position, velocity : ndarray, shape (n,)
        Of the port.
    position_input, velocity_input, acceleration_input : ndarray, shape (n_w,)
        What it senses of the inputs.
    channel : int
        Of the input or output, -1 elsewhere.
    entry : tuple of int
        Row and column of an entry of [A B; C D].
    state : int
        First of the states that the effect adds.
    output : ndarray, shape (n_y,) or (0,)
        What the sensors read of its force beside that; empty for nothing.
    """

    act: Array
    position: Array
    velocity: Array
    position_input: Array
    velocity_input: Array
    acceleration_input: Array
    channel: int
    entry: tuple[int, int]
    state: int
    output: Array

    @cached_property
    def by_displacement(self) -> Array:
        """Rates by a resisting force of unit stiffness at the port, (n, n + n_w)."""
        # a force -k d along `act` changes the rates by act d
        return np.outer(self.act, np.concatenate([self.position, self.position_input]))

    @cached_property
    def by_velocity(self) -> Array:
        """Rates by a resisting force of unit damping at the port, (n, n + n_w)."""
        return np.outer(self.act, np.concatenate([self.velocity, self.velocity_input]))


class AbsorbedLaw(Law):
    """A law that enters the matrices of the model.

    Attributes
    ----------
    states : tuple of str
        What the states that it adds are called.
    """

    states: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add it to the matrices.

        Parameters
        ----------
        into : Assembly
            Matrices, changed in place.
        site : Site
            Where it sits.
        *values : complex or float
            Coefficients in their order; complex for derivatives.
        """


def nominal_is_left(kind: str, structure: Any, place: str) -> tuple[float, float]:
    """Bounds of a change that leaves the parameter of the model positive."""
    # the change is larger than minus the value of the model
    values = [q.value for q in structure.model.parameters if (q.kind, q.place) == (kind, place)]
    return max((-value for value in values if value > 0), default=-inf), inf
