"""Laws written as a formula: at ports, at inputs and at outputs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..systems.linear import Array
from .compiled import MAX_COEFFICIENTS, address, raise_pending, through
from .law import Law

FADED = 1e-3  # share of the state before a record that may be neglected


class FormulaLaw(Law):
    """A law that is written as a formula.

    Attributes
    ----------
    signals : mapping of str to str
        Names that the formula may take beside its coefficients and constants.
    law : staticmethod
        Formula. Its arguments are told by their names. It returns the value, or with an
        inner state (it takes ``z_start``) the value and the state at the end of the step.
    slopes : staticmethod or None
        The same with derivatives by each argument behind: ``(f, f_by_first, ...)``, with an inner
        state a pair of such tuples. Needed only where the formula cannot be traced and central differences
        are too inaccurate.
    rate : staticmethod or None
        Of a law with an inner state at a port: its rate of change ``rate(d, v, z, *coefficients)``, for
        `Refinement.nonlinear_system`.

    Notes
    -----
    numba compiles the formula where it is installed, so write it for scalars, with ``math`` and
    the arithmetic of Python. A jump such as ``sgn(v)`` is written ``math.tanh(v / width)``, with
    ``jumps = True`` and a `width_share`.
    """

    signals: Mapping[str, str]
    law: Callable[..., Any]
    slopes: Callable[..., Any] | None = None
    rate: Callable[..., Any] | None = None
    scaled: bool = False
    by_name: frozenset[str] = frozenset()
    arguments: tuple[str, ...] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # formulas take no self, because numba compiles them
        for key in ("law", "slopes", "rate"):
            if inspect.isfunction(vars(cls).get(key)):
                raise ct.ControlArgument(f"{key} of {cls.__name__} is no static method: write @staticmethod")
        law = vars(cls).get("law")
        if isinstance(law, staticmethod):
            # names of the arguments tell which signals the law takes
            names = tuple(inspect.signature(law.__func__).parameters)
            cls._learn(cls, names, "needs" in vars(cls))
            # only shape coefficients: the effect has no value at which it is absent
            if "secant" not in vars(cls) and cls.where & {"input", "output"}:
                cls.secant = all(coefficient.shapes for coefficient in cls.coefficients)

    @staticmethod
    def _learn(law: Any, names: tuple[str, ...], needs_known: bool) -> None:
        """Tell from the names of the arguments what the law takes."""
        law.arguments = names
        # an inner state is told by its argument
        law.inner_states = int("z_start" in names)
        if not needs_known:
            sensed = {"position": {"d", "d_start"}, "velocity": {"v"}}
            law.needs = frozenset(need for need, told in sensed.items() if told & set(names))
            law.senses = law.needs

    def checked(self) -> FormulaLaw:
        """The law, its names held against each other.

        Raises
        ------
        control.ControlArgument
            If the formula takes a name that is no coefficient, constant or signal, leaves one out,
            or there are too many.
        """
        # each argument is a coefficient, a constant or a signal
        for name in self.arguments:
            if name not in (*self.row, *self.signals):
                raise ct.ControlArgument(
                    f"the formula of {self.name} takes {name!r}, which is none of its coefficients and "
                    f"constants ({', '.join(self.row) or 'none'}) nor of {', '.join(self.signals)}"
                )
        # each coefficient is an argument
        unused = [name for name in self.row if name not in self.arguments and not self.scaled]
        if unused and self.arguments:
            raise ct.ControlArgument(f"the formula of {self.name} does not take {', '.join(unused)}")
        # a coefficient without default needs an initial guess from the record
        unknown = [c.name for c in self.coefficients if c.default_start is None]
        if unknown and type(self).starts is Law.starts:
            raise ct.ControlArgument(
                f"{', '.join(unknown)} of {self.name} has no default_start, and the law no `starts` that "
                "tells one from a record"
            )
        if len(self.row) > MAX_COEFFICIENTS:
            raise ct.ControlArgument(
                f"{self.name} has {len(self.row)} coefficients and constants; "
                f"a law has {MAX_COEFFICIENTS} at most"
            )
        return self

    @property
    def row(self) -> tuple[str, ...]:
        """Coefficients and constants in the order in which the kernels hold them."""
        return (*self.coefficient_names, *(name for name in self.constants if name != "width"))

    @property
    def addresses(self) -> frozenset[str]:
        """Constants that are addresses in this process, and no setting."""
        return frozenset(self.constants) - frozenset(self.adjustable)

    @cached_property
    def _codes(self) -> dict[str | bytes, tuple[int, Any]]:
        """Codes of the law for each set of values that it has read.

        `address` adds to them. Kernels may still hold an old one.
        """
        self.checked()
        if not hasattr(self, "law"):
            raise ct.ControlArgument(f"{self.name} has no formula: write a static method law(...)")
        return {}

    @property
    def needs_starts(self) -> bool:
        """Return whether the user must give initial guesses of the coefficients."""
        return False

    @property
    def feels_inputs(self) -> bool:
        """Return whether the formula takes the inputs of the model."""
        return "w" in self.arguments and self.signals["w"] == "w"

    @property
    def remembers(self) -> bool:
        """Return whether the formula takes what was at the start of a step."""
        return any(self.signals.get(name) in ("d_start", "z_start") for name in self.arguments)

    @property
    def code(self) -> int:
        """Code of the law as it is now, valid in this process only.

        What the law reads is compared each time: after a change there is another code.
        """
        made = self._codes
        # a law of the package reads no variable
        if made and str(getattr(self.law, "__module__", "")).startswith(__package__):
            return next(iter(made.values()))[0]
        return address(self, made)

    def unseen(self, dt: float, *values: float) -> float:
        """Return the number of samples that depend on the unknown past.

        The past is the signal before the record.

        Parameters
        ----------
        dt : float
            Sampling time in s.
        *values : float
            Coefficients.
        """
        return 0.0

    def response(self, omega: Array, value: float) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the frequency response of an effect that `delays`.

        By default it is a dead time.

        Parameters
        ----------
        omega : ndarray
            Angular frequencies in rad/s.
        value : float
            Coefficient in s.

        Returns
        -------
        response, slope : ndarray
            Frequency response, and its derivative by the coefficient.
        """
        # dead time T: exp(-j omega T) and its derivative by T
        late = np.exp(-1j * omega * value)
        return late, -1j * omega * late

    @property
    def moves_on(self) -> bool:
        """Return whether the result changes between samples of a held signal."""
        return "held" in self.arguments and "held" in self.signals

    @property
    def feels_time(self) -> bool:
        """Return whether the formula takes the time step of its signal."""
        return "step" in self.arguments and "step" in self.signals

    def through(
        self,
        signal: Array,
        *values: float,
        slopes: Array | None = None,
        step: float = 1.0,
        held: bool = False,
        settled: int = 1,
    ) -> tuple[Array, Array, Array]:
        """Return the result of the law for a known signal.

        Parameters
        ----------
        signal : ndarray, shape (N,)
            Input or output.
        *values : float
            Coefficients and constants.
        slopes : ndarray, shape (q, N), optional
            Derivatives of the signal by something.
        step : float
            Time [s] from one value to the next.
        held : bool
            Whether each value is held up to the next one.
        settled : int
            How many of its first values the signal stood at for long; before these it was zero.

        Returns
        -------
        value : ndarray, shape (N,)
        own : ndarray, shape (4, N)
            Derivatives by the coefficients.
        slopes : ndarray, shape (q, N)
            Derivatives of the value.
        """
        # a copy: a read-only view would have the kernel compiled once more
        signal = np.array(signal, dtype=float, order="C")
        # one row of coefficients, as the kernels take them
        row = np.zeros((1, MAX_COEFFICIENTS))
        row[0, : len(values)] = values
        passed = np.zeros((0, signal.size)) if slopes is None else np.array(slopes, dtype=float)
        value, own = np.empty(signal.size), np.empty((MAX_COEFFICIENTS, signal.size))
        through(self.code, row, signal, passed, value, own, step, float(held), settled)
        raise_pending()
        return value, own, passed


class PortLaw(FormulaLaw):
    """A force at a port: ``law(d, v, ...)``.

    The formula may take ``d`` and ``v`` (displacement and velocity at the end of a step),
    ``d_start`` and ``z_start`` (displacement and inner state at its start), ``w`` (the inputs, an
    array), ``width`` and the law's coefficients and constants.
    """

    where = frozenset({"mechanical"})
    signals = MappingProxyType({name: name for name in ("d", "v", "d_start", "z_start", "w", "width")})


class InputLaw(FormulaLaw):
    """Change of an input before it acts: ``law(w, ...)``.

    The formula may take ``w`` (or ``s``), ``w_start`` and ``z_start`` (input and inner state at the start
    of the step), ``step`` (its length [s]), ``held`` (1 where w is held from here to the end of the step,
    and the value is to be the mean over it; 0 where w runs in a straight line and is reached at the end)
    and the law's coefficients and constants.
    """

    where = frozenset({"input"})
    signals = MappingProxyType(
        {"s": "d", "w": "d", "w_start": "d_start", "z_start": "z_start", "step": "width", "held": "v"}
    )


class OutputLaw(FormulaLaw):
    """Change of an output before it is recorded: ``law(y, ...)``.

    The arguments mean the same as those of an `InputLaw`; ``s`` is the signal of either.
    """

    where = frozenset({"output"})
    signals = MappingProxyType({"s": "d", "y": "d", "y_start": "d_start", "z_start": "z_start"})

    def later(self, course: CubicSpline, value: float) -> tuple[Array, Array]:
        """Return a signal behind an effect that `delays`.

        By default it is a dead time. Before the record the signal is taken as its first value.

        Parameters
        ----------
        course : CubicSpline
            Signal, or several, against time in s.
        value : float
            Coefficient in s.

        Returns
        -------
        values, slope : ndarray, shape (N, ...)
            Signal behind the effect, and its derivative by the coefficient.
        """
        # before the delay has passed, the first value; no derivative there
        time = np.maximum(course.x - value, 0.0)
        moving = (course.x > value).reshape(-1, *[1] * (course.c.ndim - 2))
        return course(time), -course(time, 1) * moving
