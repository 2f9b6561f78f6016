"""An effect: a law at a place, with one or a few coefficients."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import control as ct

from ..arguments import as_choice, as_mapping, as_number, as_text
from ..exceptions import ModelError
from .custom import Custom
from .domains import DOMAINS, worded
from .kinds import kind_named
from .law import KINDS, Law, instance_of

__all__ = ["ARGUMENTS", "Effect"]

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
        the ``"width"`` over which the sign of a velocity is smoothed).
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
        if isinstance(law, type) and issubclass(law, Law):
            kind, law = _own_kind(kind, law)
        else:
            kind = kind_named(kind)
        if not isinstance(place, str) or not place.strip():
            raise ct.ControlArgument(
                f"place of {kind} must be the name of a port or of a channel, not {place!r}; "
                "ports(model) lists the ports"
            )
        if name is not None:
            as_text(name, f"name of {kind} at {place}")
        own: Any = law if isinstance(law, type) and issubclass(law, Law) else None
        if law is not None and own is None and not KINDS[kind].needs_law:
            raise ct.ControlArgument(f"law= is for kind 'custom' only (and 'tabulated'), not for {kind!r}")
        store = object.__setattr__
        store(self, "kind", kind)
        store(self, "place", place)
        store(self, "_domain", "mechanical")
        store(self, "law", law)
        store(self, "name", name)
        for key, values in (("start", start), ("fixed", fixed), ("prior", prior)):
            store(self, f"_{key}", as_mapping(values, f"{key} of {kind} at {place}", "numbers"))
        label = f"{kind} effect at {place}"
        spec = instance_of(own) if own else KINDS[kind].of(law, tuple(self._start), label)
        store(self, "spec", spec)
        self._check_values()

    def _check_values(self) -> None:
        coefficients = self.coefficients
        constants = self.spec.adjustable
        allowed = {"start": coefficients, "fixed": coefficients + constants, "prior": coefficients}
        for argument, names in allowed.items():
            values: dict[str, float] = getattr(self, "_" + argument)
            for key, value in values.items():
                where = f"{argument}[{key!r}] of {self.kind} at {self.place}"
                if key not in names:
                    raise ct.ControlArgument(f"{where}: no such coefficient, only {', '.join(names)}")
                number = as_number(value, where, error=ModelError)
                if argument == "prior" and number <= 0:
                    raise ModelError(f"{where} is a standard deviation and must be positive, not {number}")
                if argument == "fixed" and key in constants and not number > 0:
                    if number or key not in self.spec.from_zero:
                        raise ModelError(f"{where} must be positive, not {number}")
                if argument != "prior" and key in coefficients:
                    lower, upper = self.bounds(key)
                    if not lower <= number <= upper:
                        raise ModelError(f"{where} = {number:g} is outside [{lower:g}, {upper:g}]")
                values[key] = number
        known = {**self._start, **self._fixed}
        for larger, smaller in self.spec.order:
            if larger in known and smaller in known and known[larger] < known[smaller]:
                raise ModelError(
                    f"{larger} = {known[larger]:g} of {self.kind} at {self.place} is below {smaller} = "
                    f"{known[smaller]:g}; it is at least as large"
                )
        twice = sorted(set(self._fixed) & (set(self._start) | set(self._prior)))
        if twice and self.kind != Custom.name:
            raise ModelError(
                f"{', '.join(twice)} of {self.label} is both fixed and given a start or prior; give one"
            )

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
        return self.name or f"{worded(self.spec.words[0], self._domain) or self.kind} at {self.place}"

    @property
    def key(self) -> str:
        """Kind and place, ``"coulomb_friction@link2"``."""
        return f"{self.kind}@{self.place}"

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
        return _restore({name: getattr(self, name) for name in ARGUMENTS}, port_kind)

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
        given = {name: getattr(self, name) for name in ARGUMENTS}
        return _restore(given | changes, self._domain)

    def _key(self) -> tuple[Any, ...]:
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
        # a class brings itself along, where the other side may not know it yet
        law = self.law if self.law is not None or own.__module__.startswith(__package__) else own
        given = {name: getattr(self, name) for name in ARGUMENTS} | {"law": law}
        return (_restore, (given, self._domain))

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
