"""An effect: a law at a place, with one or a few coefficients."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from typing import Any
from weakref import WeakSet

import control as ct
import numpy as np

from ..arguments import as_choice, as_list, as_mapping, as_number, as_text, shown
from ..exceptions import ModelError
from ..systems.linear import Array
from .compiled import MAX_COEFFICIENTS, forces_along, raise_pending
from .domains import DOMAINS, kind_named, worded
from .formula import PortLaw
from .given import Custom
from .law import KINDS, Law, instance_of

_OTHER = " (other side)"  # behind the name of an effect with side = -1
ARGUMENTS = ("kind", "place", "start", "fixed", "prior", "law", "name")


class Effect:
    """A physical effect that the initial model lacks.

    Parameters
    ----------
    kind : str
        Law, a key of `KINDS` (``"coulomb_friction"``, ``"stiffness"``, ...), or the name that is printed
        for it (``"series resistance"``).
    place : str
        Where it acts: a port (``"link2"``, ``"x1-x2"``), an input or an output
        label, or for `coefficient` an entry ``"A[i,j]"`` (B, C, D) counted from 0.
    start : mapping of str to float, optional
        Values of coefficients to start an estimate from. For `custom`,
        the names here are the coefficients of the law.
    fixed : mapping of str to float, optional
        Coefficients that are held at a value, and constants of the kind (such as
        the ``"width"`` over which the sign of a velocity is smoothed, or the ``"side"`` on which a law
        acts that acts on one side: 1, or -1 for the other one; `diagnose` tries both if none is given).
    prior : mapping of str to float, optional
        Prior standard deviation of coefficients, about their start value.
    law : callable or Table, optional
        For `tabulated` a `Table`. For `custom` ``law(d, v)`` returns the force per unit ``scale``, or
        ``law(d, v, **coefficients)`` the force, where `start` names coefficients.
        d and v are arrays, or v alone has meaning at a first-order port. Use a
        function of a module: a lambda cannot be pickled.
    name : str, optional
        Name to show instead of ``"kind at place"``.

    Attributes
    ----------
    label : str
        ``"coulomb_friction at link2"``, or the given name; where the model's units tell the domain,
        its words: ``"series resistance at winding"``.
    key : str
        ``"coulomb_friction@link2"``: kind and place, as every argument that names effects takes them.
    coefficients : tuple of str
        All coefficients, those held fixed included.
    free : tuple of str
        Coefficients to estimate.
    explanation : str
        A sentence for people.
    spec : Law
        The law, with all that is known of it.

    Raises
    ------
    control.ControlArgument
        If the kind is unknown, or a name is not one of the kind's.
    ModelError
        If a value is not finite, outside its bounds, or contradictory.

    Notes
    -----
    A positive coefficient at a port means more resistance, so damage is negative.
    Two effects are equal if kind, place, fixed values, law and name are.

    Examples
    --------
    >>> friction = Effect("coulomb_friction", "link2")
    >>> friction.label, friction.coefficients
    ('coulomb_friction at link2', ('force',))
    >>> print(friction.explanation)
    Dry friction acts at link2: a force of constant size that opposes the motion.
    """

    __slots__ = ("_domain", "_fixed", "_prior", "_start", "kind", "law", "name", "place", "spec")
    kind: str
    place: str
    law: Callable[..., Any] | None
    name: str | None
    spec: Law
    _domain: str
    _start: dict[str, float]
    _fixed: dict[str, float]
    _prior: dict[str, float]

    def __init__(
        self,
        kind: str,
        place: str,
        *,
        start: Mapping[str, float] | None = None,
        fixed: Mapping[str, float] | None = None,
        prior: Mapping[str, float] | None = None,
        law: Callable[..., Any] | None = None,
        name: str | None = None,
    ) -> None:
        # law given as a class of the user
        own: Any = None
        if isinstance(law, type) and issubclass(law, Law):
            kind, law = _own_kind(kind, law)
            own = law
        else:
            kind = kind_named(kind)
        if not isinstance(place, str) or not place.strip():
            raise ct.ControlArgument(
                f"place of {kind} must be the name of a port or of a channel, not {place!r}; "
                "ports(model) lists the ports"
            )
        if name is not None:
            as_text(name, f"name of {kind} at {place}")
        if law is not None and own is None and not KINDS[kind].needs_law:
            raise ct.ControlArgument(f"law= is for kind 'custom' only (and 'tabulated'), not for {kind!r}")
        # an effect is immutable: its attributes are set once, past __setattr__
        store = object.__setattr__
        store(self, "kind", kind)
        store(self, "place", place)
        store(self, "_domain", "mechanical")
        store(self, "law", law)
        store(self, "name", name)
        for key, values in (("start", start), ("fixed", fixed), ("prior", prior)):
            store(self, f"_{key}", as_mapping(values, f"{key} of {kind} at {place}", "numbers"))
        # the catalogue's law, or the one that the user's function defines
        label = f"{kind} effect at {place}"
        spec = instance_of(own) if own else KINDS[kind].of(law, tuple(self._start), label)
        store(self, "spec", spec)
        self._check_values()
        # functions that a saved file may name later, see `law_here`
        if inspect.isfunction(plain := _plain(law)):
            _MADE.add(plain)

    def _check_values(self) -> None:
        coefficients = self.coefficients
        # names that each argument may hold
        allowed = {"start": coefficients, "fixed": coefficients + self.spec.adjustable, "prior": coefficients}
        for argument, names in allowed.items():
            values: dict[str, float] = getattr(self, "_" + argument)
            for key, value in values.items():
                where = f"{argument}[{key!r}] of {self.kind} at {self.place}"
                if key not in names:
                    raise ct.ControlArgument(f"{where}: no such coefficient, only {', '.join(names)}")
                values[key] = as_number(value, where, error=ModelError)
                self._check_range(argument, key, values[key], where)
        # coefficients that are ordered, such as static above Coulomb force
        known = {**self._start, **self._fixed}
        for larger, smaller in self.spec.order:
            if larger in known and smaller in known and known[larger] < known[smaller]:
                raise ModelError(
                    f"{larger} = {known[larger]:g} of {self.kind} at {self.place} is below {smaller} = "
                    f"{known[smaller]:g}; it is at least as large"
                )
        # a coefficient is either held or estimated
        twice = sorted(set(self._fixed) & (set(self._start) | set(self._prior)))
        if twice and self.kind != Custom.name:
            raise ModelError(
                f"{', '.join(twice)} of {self.label} is both fixed and given a start or prior; give one"
            )

    def _check_range(self, argument: str, key: str, number: float, where: str) -> None:
        if argument == "prior":
            if number <= 0:
                raise ModelError(f"{where} is a standard deviation and must be positive, not {number}")
            return
        # constants are scales, and therefore positive
        scale = argument == "fixed" and key in self.spec.adjustable
        if scale and key == "side":
            if abs(number) != 1.0:
                raise ModelError(f"{where} must be 1 or -1, not {number:g}")
        elif scale and (number < 0 or (number == 0 and key not in self.spec.from_zero)):
            raise ModelError(f"{where} must be positive, not {number}")
        # values within the bounds of the law
        lower, upper = self.bounds(key) if key in self.coefficients else (-np.inf, np.inf)
        if not lower <= number <= upper:
            raise ModelError(f"{where} = {number:g} is outside [{lower:g}, {upper:g}]")

    @property
    def start(self) -> dict[str, float]:
        """Start values that were given."""
        return dict(self._start)

    @property
    def fixed(self) -> dict[str, float]:
        """Values that are held."""
        return dict(self._fixed)

    @property
    def prior(self) -> dict[str, float]:
        """Prior standard deviations that were given."""
        return dict(self._prior)

    @property
    def label(self) -> str:
        """Name to show, by default ``"kind at place"``.

        The default uses the words of the place's domain.
        """
        words = worded(self.spec.words[0], self._domain) or self.kind
        return self.name or f"{words} at {self.place}{self._side}"

    @property
    def key(self) -> str:
        """Kind and place, ``"coulomb_friction@link2"``."""
        return f"{self.kind}@{self.place}{self._side}"

    @property
    def _side(self) -> str:
        return _OTHER * (self._fixed.get("side") == -1.0)

    @property
    def sides(self) -> list[Effect]:
        """The effect, and the same on the other side if no side was given."""
        if "side" in self._fixed or "side" not in self.spec.constants:
            return [self]
        return [self, self.replace(fixed={**self._fixed, "side": -1.0})]

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of all coefficients."""
        return self.spec.coefficient_names

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the coefficients that are not fixed."""
        return tuple(name for name in self.coefficients if name not in self._fixed)

    @property
    def constants(self) -> dict[str, float | None]:
        """Constants of the kind, with the values given in `fixed`."""
        return {key: self._fixed.get(key, value) for key, value in self.spec.constants.items()}

    @property
    def is_linear(self) -> bool:
        """Return whether the refined model stays linear."""
        return self.spec.linear

    @property
    def explanation(self) -> str:
        """Meaning of the effect, in one sentence."""
        text = worded(self.spec.words[1], self._domain) or self.spec.explanation
        return text.format(place=self.place)

    def at_port(self, port_kind: str) -> Effect:
        """Copy in the words of a port's domain, otherwise equal.

        Parameters
        ----------
        port_kind : str
            Domain of the port that `place` names (`Port.domain`): ``"mechanical"``, ``"rotational"``,
            ``"current"``, ``"voltage"``, ``"thermal"``, ``"hydraulic"``, or ``"first_order"`` for another
            state. A loss at a tank reads differently from friction at a joint.

        Returns
        -------
        Effect
            Equal effect whose `label` and `explanation` fit the place.

        Examples
        --------
        >>> Effect("damping", "iL").at_port("current").label
        'series resistance at iL'
        """
        as_choice(port_kind, "port_kind", tuple(DOMAINS))
        if port_kind == self._domain:
            return self
        return _restore(self._given(), port_kind)

    def bounds(self, coefficient: str) -> tuple[float, float]:
        """Lower and upper bound that physics sets.

        Parameters
        ----------
        coefficient : str
            Name of a coefficient.

        Returns
        -------
        tuple of float
            Bounds, infinite where there is none.
        """
        as_choice(coefficient, f"coefficient of {self.label}", self.coefficients)
        entry = self.spec.coefficient(coefficient)
        return entry.lower, entry.upper

    def start_of(self, coefficient: str) -> float | None:
        """Value to start from, None where it must be found from the data.

        Parameters
        ----------
        coefficient : str
            Name of a coefficient.

        Returns
        -------
        float or None
            Given or default start value.
        """
        as_choice(coefficient, f"coefficient of {self.label}", self.coefficients)
        # held value, else the given start, else the default of the law
        if coefficient in self._fixed:
            return self._fixed[coefficient]
        if coefficient in self._start:
            return self._start[coefficient]
        return self.spec.coefficient(coefficient).default_start

    def replace(self, **changes: Any) -> Effect:
        """Copy with other arguments.

        Parameters
        ----------
        **changes
            Arguments of `Effect` (`start=`, `fixed=`, `place=`, ...).

        Returns
        -------
        Effect
            New effect.
        """
        return _restore(self._given() | changes, self._domain)

    def _given(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ARGUMENTS}

    def _key(self) -> tuple[Any, ...]:
        # starts and priors do not make another effect
        return (self.kind, self.place, tuple(sorted(self._fixed.items())), self.law, self.name)

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, Effect) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"an Effect cannot be changed; use .replace({name}=...) for a copy")

    def __delattr__(self, name: str) -> None:
        raise AttributeError("an Effect cannot be changed")

    def __reduce__(self) -> tuple[Any, ...]:
        own = type(self.spec)
        # pickle the class of the law, which the other process may not have registered
        law = self.law if self.law is not None or own.__module__.startswith(__package__) else own
        return _restore, (self._given() | {"law": law}, self._domain)

    def __repr__(self) -> str:
        given = [repr(self.kind), repr(self.place)]
        given += [
            f"{key}={getattr(self, key)!r}" for key in ("start", "fixed", "prior") if getattr(self, key)
        ]
        if self.law is not None:
            given.append(f"law={getattr(self.law, '__name__', repr(self.law))}")
        if self.name is not None:
            given.append(f"name={self.name!r}")
        return f"Effect({', '.join(given)})"

    def __str__(self) -> str:
        return self.label


def _own_kind(kind: Any, law: type[Law]) -> tuple[str, type[Law] | None]:
    """Return the kind of an effect whose law is a class, and the class.

    The class is replaced by None if the catalogue holds it.
    """
    if kind not in (Custom.name, law.name):
        raise ct.ControlArgument(
            f"the kind of an effect with law {law.__name__} is {law.name!r}, not {kind!r}"
        )
    held = KINDS.get(law.name)
    if held is not None and type(held) is not law:
        raise ct.ControlArgument(f"the catalogue has a law {law.name!r}; give {law.__name__} another name")
    return law.name, law if held is None else None


def _restore(given: dict[str, Any], domain: str) -> Effect:
    """Effect of arguments, in the words of a domain."""
    effect = Effect(**given)
    object.__setattr__(effect, "_domain", domain)
    return effect


def hold_coefficients(effect: Effect, values: Mapping[str, float]) -> Effect:
    """Return an effect with these coefficients held.

    They may lie outside their bounds: an estimate on a stream has none.
    """
    held, store = object.__new__(Effect), object.__setattr__
    for name in Effect.__slots__:
        store(held, name, getattr(effect, name))
    for name, given in (("_start", {}), ("_prior", {}), ("_fixed", {**effect.fixed, **values})):
        store(held, name, given)
    return held


def as_effects(values: Any, name: str) -> list[Effect]:
    """Return effects from one or a list of them, or of their names.

    A name is a key ``"coulomb_friction@link2"``, or what is printed: ``"series resistance at winding"``.

    Raises
    ------
    control.ControlArgument
        If an entry is something else, or names no effect.
    """
    given = [values] if isinstance(values, Effect | str) else as_list(values, name, "Effect objects")
    effects = [effect_named(each, name) if isinstance(each, str) else each for each in given]
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ct.ControlArgument(f"{name} must hold Effect objects, not {shown(effect)}")
    return effects


def effect_named(text: str, name: str) -> Effect:
    """Return the effect of a name ``"kind@place"`` or ``"kind at place"``."""
    whole, other, _ = text.partition(_OTHER)
    kind, at, place = (part.strip() for part in whole.partition("@" if "@" in text else " at "))
    if not (kind and at and place):
        raise ct.ControlArgument(f"{name} must hold Effect objects, or names as 'kind@place', not {text!r}")
    return Effect(kind, place, fixed={"side": -1.0} if other else None)


_MADE: WeakSet[Callable[..., Any]] = WeakSet()  # functions of which this process has made an effect


def _plain(law: Any) -> Any:
    """Return the function that numba compiled, or the law itself."""
    return inspect.getattr_static(law, "py_func", law)


def import_path(effect: Effect) -> str:
    """Name of an effect's own law as ``"module:qualname"``.

    Parameters
    ----------
    effect : Effect
        Effect.

    Returns
    -------
    str
        Empty for laws of this package, and for a law that no name leads to (a lambda, what is
        defined inside a function).
    """
    own = type(effect.spec)
    inside = own.__module__.split(".")[0] == __name__.split(".")[0]
    law: Any = effect.law if effect.law is not None or inside else own
    module, name = getattr(law, "__module__", None), getattr(law, "__qualname__", None)
    # laws of this package need no path
    if law is None or not module or not name:
        return ""
    # does the path lead to this very object?
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return f"{module}:{name}" if found is law else ""


def law_here(path: str, label: str) -> Any:
    """Return the law that `import_path` named, from imported modules.

    A file decides which function is called, and with which values. Therefore nothing is imported for it, and
    only functions of which this process has made an effect, and laws, that a module itself defines, are
    returned: no lazy attribute, nothing that it imported, nothing of Python's library or of this package.

    Parameters
    ----------
    path : str
        ``"module:qualname"``.
    label : str
        Effect, for messages.

    Returns
    -------
    callable or subclass of Law

    Raises
    ------
    ModelError
        If no imported module has it.
    """
    module, _, name = path.partition(":")
    found: Any = sys.modules.get(module)
    # without lazy attributes, so that no code of the module runs
    for part in name.split("."):
        found = inspect.getattr_static(found, part, None)
        found = found.__func__ if isinstance(found, staticmethod) else found
    plain = _plain(found)
    ours = plain in _MADE if inspect.isfunction(plain) else isinstance(plain, type) and issubclass(plain, Law)
    # neither the standard library nor this package holds laws of a user
    library = module.split(".")[0] in sys.stdlib_module_names | {__name__.split(".")[0]}
    if library or not ours or (plain.__module__, plain.__qualname__) != (module, name):
        raise ModelError(
            f"the law of {label!r} was saved as {path}, and a file neither imports a module nor calls a "
            f"function that is no law in this process: pass laws={{{label!r}: law}}"
        )
    return found


def module_of(name: str) -> str:
    """Module that a dotted name begins with, "" where none is imported."""
    while name and name not in sys.modules:
        name = name.rpartition(".")[0]
    return name


_SHARP = 1e-300  # width of a jump that is practically zero


def unit_forces(
    effect: Effect,
    d: Array,
    v: Array,
    shapes: list[dict[str, float]],
    w: Array | None = None,
    rest: tuple[float, float] | None = None,
) -> list[Array] | None:
    """Columns of force (N,), one per coefficient that scales it and per shape.

    Parameters
    ----------
    effect : Effect
        Law at a port.
    d, v : ndarray, shape (N,)
        Displacement and velocity there.
    shapes : list of dict
        Values of the coefficients that shape the law, to be tried.
    w : ndarray, shape (n_w, N), optional
        Inputs, for laws that feel them.
    rest : two floats, optional
        Displacement and velocity at an operating point: force and tangent there are subtracted, but no
        tangent by a velocity that is zero.

    Returns
    -------
    list of ndarray, or None
        None for a law that is not a force along a motion.
    """
    law, simple = effect.spec, {"displacement": d, "velocity": v, "constant": np.ones(v.size)}
    if rest is not None and law.signal != "constant":
        return _forces_above(effect, np.array([d, v]), shapes, rest)
    # linear in one signal: that signal itself
    if law.signal in simple:
        return [np.asarray(simple[law.signal], dtype=float)]
    if not isinstance(law, PortLaw) or law.needs_starts or (law.feels_inputs and w is None):
        return None
    # a copy: a read-only view would have the kernel compiled once more
    inputs = np.zeros((d.size, 0)) if w is None else np.array(w.T, order="C")
    columns = list[Array]()
    # one column for each coefficient that scales the force, in each shape
    for shape in shapes if law.shaping else [{}]:
        values = {**law.constants, **effect.fixed, **shape}
        if not law.shaping <= values.keys():
            return None
        columns += _force_columns(law, values, d, v, inputs)
    return columns


def _force_columns(
    law: PortLaw, values: dict[str, float | None], d: Array, v: Array, inputs: Array
) -> list[Array]:
    """Return the force per unit of each coefficient that scales it."""
    d, v = np.ascontiguousarray(d, dtype=float), np.ascontiguousarray(v, dtype=float)
    row = np.zeros((1, MAX_COEFFICIENTS))
    row[0, : len(law.row)] = [values.get(name) or 0.0 for name in law.row]
    found = np.zeros((len(law.coefficients), d.size))
    with np.errstate(all="ignore"):
        forces_along(law.code, d, v, inputs, row, _SHARP, found)
    raise_pending()
    return [found[c] for c, name in enumerate(law.coefficient_names) if name not in law.shaping]


def _forces_above(
    effect: Effect, motion: Array, shapes: list[dict[str, float]], rest: tuple[float, float]
) -> list[Array] | None:
    """Return forces less force and tangent at an operating point.

    The tangent is found by central differences.
    """
    law = effect.spec
    sizes = np.abs([rest[0] or np.abs(motion[0]).max(initial=0.0), rest[1]]) * (not law.linear)
    steps = 1e-5 * sizes * (not law.inner_states)
    near = np.array(rest)[:, None] + steps[:, None] * [[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]]
    per, moved = 0.5 * steps / np.maximum(steps, 1e-150) ** 2, np.hstack([near, motion])
    # at an operating point no law takes the inputs
    whole, above = unit_forces(effect, moved[0], moved[1], shapes), motion - near[:, :1]
    return whole and [f[5:] - f[0] - (f[[1, 3]] - f[[2, 4]]) * per @ above for f in whole]
