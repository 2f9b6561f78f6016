"""Linear mechanical models from mass, damping and stiffness matrices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import control as ct
import numpy as np
from scipy.linalg import eigh
from scipy.sparse import csc_matrix, diags, issparse
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh, splu

from ... import arguments
from ...arguments import as_text
from ...exceptions import ModelError
from ...systems.linear import Array
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ._assembly import Place, SecondOrder, Units, unit_vector
from ._checks import as_index, as_matrix, as_vector
from ._model import Given
from ._sensors import input_map, parse_sensors

__all__ = ["mechanical"]

_SHIFT = 1e-8  # below zero, in the middle of the squared frequencies that each displacement has alone
_DENSE = 200  # displacements, up to which all modes are as fast
_SAME = 1e-6  # relative difference of squared frequencies that says nothing


def as_sparse(value: Any, name: str, size: int, *, symmetric: bool) -> csc_matrix:
    """Square matrix of finite numbers, whose zeros take no room."""
    if not issparse(value):
        return csc_matrix(as_matrix(value, name, size, symmetric=symmetric))
    if value.dtype.kind not in "fiu":
        raise ct.ControlArgument(f"{name} must hold real numbers, not {value.dtype}")
    matrix = csc_matrix(value, dtype=float)
    if matrix.shape != (size, size):
        raise ct.ControlDimension(f"{name} has shape {matrix.shape}, expected {(size, size)}")
    if not np.isfinite(matrix.data).all():
        raise ModelError(f"{name} has a value that is not finite")
    if symmetric and abs(matrix - matrix.T).max() > 1e-8 * abs(matrix).max():
        raise ModelError(
            f"{name} is not symmetric; a Matrix Market file that holds a half must say `symmetric`"
        )
    return matrix


def lowest_modes(M: csc_matrix, K: csc_matrix, count: int) -> tuple[Array, Array]:
    """Return squared frequencies and mode shapes, the lowest first.

    Their shapes are (count,) and (n, count), and Phi' M Phi = I.

    Raises
    ------
    ModelError
        If M is not positive definite, K has a negative direction, or modes cannot be told from others.
    """
    n = M.shape[0]
    if M.diagonal().min() <= 0 or _negative(M):
        raise ModelError("M must be positive definite: every displacement needs a mass")
    middle = float(np.median(np.abs(K.diagonal()) / M.diagonal())) or 1.0
    shift = -_SHIFT * middle
    if n <= _DENSE or 2 * count >= n:
        squares, shapes = eigh(K.toarray(), M.toarray(), subset_by_index=[0, count - 1])
    else:
        squares, shapes = _by_lanczos(M, K, count, shift)
    if squares[0] < shift:
        raise ModelError(
            f"K has a negative direction (omega^2 = {squares[0]:g}); the structure would not stand"
        )
    squares = np.where(np.abs(squares) <= _SAME * abs(shift), 0.0, squares)
    shapes = shapes * np.sign(shapes[np.argmax(np.abs(shapes), axis=0), np.arange(count)])
    return squares, shapes


def _by_lanczos(M: csc_matrix, K: csc_matrix, count: int, shift: float) -> tuple[Array, Array]:
    """Return the lowest modes by shift-and-invert Lanczos iteration.

    The shift lies below zero, because rigid-body modes make K itself singular.
    """
    solved = _factors(K - shift * M)
    if (solved.U.diagonal() < 0).any():
        raise ModelError("K has a negative direction; the structure would not stand")
    try:
        squares, shapes = eigsh(
            K,
            k=count,
            M=M,
            sigma=shift,
            OPinv=LinearOperator(K.shape, solved.solve, dtype=float),
            v0=np.random.default_rng(0).standard_normal(K.shape[0]),
        )
    except ArpackError as error:
        raise ModelError(f"the lowest {count} modes did not converge: {error}") from error
    order = np.argsort(squares)
    squares, shapes = squares[order], shapes[:, order]
    # none is left out where as many lie below the last as were found there (Sylvester)
    last = squares[-1] - _SAME * (squares[-1] - shift)
    if _negative(K - last * M) != int((squares < last).sum()):
        raise ModelError(f"a mode below {np.sqrt(squares[-1]):g} rad/s was missed; ask for other n_modes")
    return squares, shapes


def _factors(X: csc_matrix) -> Any:
    """Factor a symmetric matrix without row exchanges.

    There are then as many negative pivots as negative eigenvalues.
    """
    return splu(
        csc_matrix(X), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def _negative(X: csc_matrix) -> int:
    try:
        return int((_factors(X).U.diagonal() < 0).sum())
    except RuntimeError:  # exactly singular
        return -1


def mechanical(
    M: Any,
    C: Any = None,
    K: Any = None,
    *,
    damping_ratio: float | Sequence[float] | None = None,
    excitation: str = "force",
    force_map: int | Sequence[int] | Array | None = None,
    links: Mapping[str, Any] | None = None,
    sensors: Any = "displacement",
    n_modes: int | None = None,
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    position_unit: str = "m",
    force_unit: str = "N",
    name: str = "structure",
) -> PhysicalModel:
    """Mechanical model M q'' + C q' + K q = F w.

    Parameters
    ----------
    M : array_like or sparse array of shape (n, n)
        Mass matrix, symmetric and positive definite; n numbers make a diagonal one. `M`, `C` and `K` may
        be sparse, as `scipy.io.mmread` gives them.
    C : array_like of shape (n, n), optional
        Damping matrix; not symmetric where there are gyroscopic forces.
        Zero if neither it nor `damping_ratio` is given.
    K : array_like of shape (n, n), optional
        Stiffness matrix, symmetric; zero if it is not given.
    damping_ratio : float or sequence of n floats, optional
        Modal damping ratios, in the order of the natural frequencies, in place of `C`:
        C = M Phi diag(2 zeta omega) Phi' M with Phi' M Phi = I. With `n_modes` one for each of these.
    excitation : {"force", "base"}, optional
        ``"base"`` makes the acceleration of the base, the same for all displacements, the
        first input; the states are then relative to the base.
    force_map : int, sequence of int or ndarray of shape (n, n_w), optional
        F as a 2-D array, or the numbers (from 1) of the displacements that a force acts on;
        default 1 (none under base excitation).
    links : mapping of str to tuple or ndarray, optional
        Names of places between displacements: ``{"brace": (1, 3)}`` has d = q_1 - q_3,
        ``{"foot": (1, 0)}`` d = q_1 to the ground, and a vector g of length n
        d = g @ q. Default: every pair that K or C couples, named ``"mass1-mass2"``.
    sensors : str, tuple or list, optional
        As for `mass_spring_damper`, ``("velocity", 1)`` and so on.
    n_modes : int, optional
        Keep the lowest so many modes, those of a rigid body among them: for matrices of
        finite elements. The states are then modal, q = Phi eta with Phi' M Phi = I.
    inputs, outputs, states : str or sequence of str, optional
        Labels.
    position_unit, force_unit : str, optional
        Units to print.
    name : str, optional
        Name of the system.

    Returns
    -------
    PhysicalModel
        Model with a port for each link and ``mass1..mass{n}`` for the displacements; with `n_modes`
        for each of the named `links` (none by default) and ``mode1..mode{n_modes}``.

    Raises
    ------
    control.ControlDimension
        If sizes do not fit.
    ModelError
        If M is not positive definite or a matrix is not symmetric; with `n_modes` also if there are not as
        many modes or K has a negative direction.

    Notes
    -----
    What `n_modes` leaves out is also missing below the last mode kept: the static part of the higher
    modes. Keep modes up to twice the highest frequency of interest, and compare with one more.

    Any symmetric K is a sum of springs between pairs (-K_ij) and to the ground (the sum of row
    i, at ``mass{i}``). These are the nominal parameters; those of C likewise, if it was given.

    Examples
    --------
    >>> model = mechanical([2.0, 1.0], K=[[3.0, -1.0], [-1.0, 1.0]], damping_ratio=0.02)
    >>> [port.name for port in model.ports]
    ['mass1-mass2', 'mass1', 'mass2']
    >>> bool(np.allclose(ct.damp(model.system, doprint=False)[1], 0.02))
    True

    A free-free bar of 500 elements, by its rigid mode and its first two elastic ones:

    >>> from scipy.sparse import diags
    >>> ends = np.r_[1.0, np.full(499, 2.0), 1.0]
    >>> K = diags([-np.ones(500), ends, -np.ones(500)], [-1, 0, 1]) * 500.0
    >>> bar = mechanical(diags(ends / 1000), K=K, damping_ratio=0.01, n_modes=3, sensors=("velocity", 501))
    >>> [port.name for port in bar.ports]
    ['mode1', 'mode2', 'mode3']
    >>> [round(q.value**0.5 / np.pi, 3) for q in bar.parameters if q.kind == "stiffness"]
    [0.0, 1.0, 2.0]
    """
    if n_modes is not None:
        return _by_modes(
            M, C, K, n_modes, damping_ratio, links, sensors, excitation, force_map,
            Units(as_text(position_unit, "position_unit"), as_text(force_unit, "force_unit")),
            (inputs, outputs, states, name),
        )  # fmt: skip
    mass, damping, stiffness = _whole(M, C, K, damping_ratio)
    n = mass.shape[0]
    listed = damping if C is not None and np.allclose(damping, damping.T) else np.zeros((n, n))
    places, pairs = _named_links(links, n) if links is not None else _found_links(stiffness, listed)
    points = [
        Place(f"mass{i + 1}", unit_vector(n, (i, 1.0)), f"displacement {i + 1} itself (d = q{i + 1})", True)
        for i in range(n)
    ]
    places = [*places, *points]
    units = Units(as_text(position_unit, "position_unit"), as_text(force_unit, "force_unit"))
    F, base, input_default, input_units = input_map(excitation, force_map, mass, units)
    parameters = _link_parameters(mass, listed, stiffness, pairs, units)
    found = parse_sensors(sensors, n, {place.name: place for place in places}, base, units, parameters)
    return SecondOrder(mass, damping, stiffness, F, base, units).build(
        places,
        found,
        parameters,
        (inputs, outputs, states, name),
        inputs=input_default,
        input_units=input_units,
    )


def _whole(M: Any, C: Any, K: Any, damping_ratio: Any) -> tuple[Array, Array, Array]:
    """Mass, damping and stiffness, checked."""
    M, C, K = (X.toarray() if issparse(X) else X for X in (M, C, K))
    given = np.atleast_1d(arguments.as_array(M, "M", error=ModelError))
    given = np.diag(as_vector(given, "M")) if given.ndim == 1 else given
    n = given.shape[0]
    mass = as_matrix(given, "M", n, symmetric=True)
    smallest = float(np.linalg.eigvalsh(mass)[0])
    if smallest <= 0:
        raise ModelError(
            f"M must be positive definite, its smallest eigenvalue is {smallest:g}; "
            "every displacement needs a mass"
        )
    stiffness = np.zeros((n, n)) if K is None else as_matrix(K, "K", n, symmetric=True)
    damping = np.zeros((n, n)) if C is None else as_matrix(C, "C", n, symmetric=False)
    if damping_ratio is not None:
        if C is not None:
            raise ct.ControlArgument("give C or damping_ratio, not both")
        damping = _modal_damping(mass, stiffness, damping_ratio)
    return mass, damping, stiffness


def _by_modes(
    M: Any, C: Any, K: Any, n_modes: Any, ratio: Any, links: Any, sensors: Any, excitation: str,
    force_map: Any, units: Units, given: Given,
) -> PhysicalModel:  # fmt: skip
    """Return a model that consists of the lowest modes of a structure.

    Its sensors, forces and named links are projected on the modes.
    """
    if not issparse(M):
        M = np.atleast_1d(arguments.as_array(M, "M", error=ModelError))
        M = diags(as_vector(M, "M"), format="csc") if M.ndim == 1 else M
    n = M.shape[0]
    r = as_index(n_modes, "n_modes", n) + 1
    mass = as_sparse(M, "M", n, symmetric=True)
    stiffness = csc_matrix((n, n)) if K is None else as_sparse(K, "K", n, symmetric=True)
    squares, shapes = lowest_modes(mass, stiffness, r)
    damping = np.zeros((r, r))
    if C is not None:
        if ratio is not None:
            raise ct.ControlArgument("give C or damping_ratio, not both")
        damping = shapes.T @ (as_sparse(C, "C", n, symmetric=False) @ shapes)
    elif ratio is not None:
        damping = np.diag(2.0 * _ratios(ratio, r) * np.sqrt(squares))
    places = [] if links is None else _named_links(links, n)[0]
    F, base, input_default, input_units = input_map(excitation, force_map, mass, units)
    found = parse_sensors(sensors, n, {place.name: place for place in places}, base, units)
    rows = [
        replace(s, **{key: getattr(s, key) @ shapes for key in ("displacement", "velocity", "acceleration")})
        for s in found
    ]
    modes = [
        Place(f"mode{i + 1}", unit_vector(r, (i, 1.0)), f"mode of {np.sqrt(w2):.4g} rad/s", absolute=False)
        for i, w2 in enumerate(squares)
    ]
    own = [replace(place, direction=place.direction @ shapes) for place in places]
    diagonal = {"damping": np.diag(damping), "stiffness": squares}
    model = SecondOrder(np.eye(r), damping, np.diag(squares), shapes.T @ F, 0.0 * base, units).build(
        [*own, *modes],
        rows,
        [
            NominalParameter(f"{kind[0]}[{mode.name}]", float(value), "", kind, mode.name)
            for kind, values in diagonal.items()
            for mode, value in zip(modes, values, strict=True)
        ],
        given,
        inputs=input_default,
        input_units=input_units,
        letters=("eta", "deta"),
    )
    ports = tuple(
        replace(p, modal=True, position_unit="", velocity_unit="", force_unit="") if k >= len(own) else p
        for k, p in enumerate(model.ports)
    )
    return replace(model, ports=ports, state_units=("",) * (2 * r))


def _ratios(ratio: Any, count: int) -> Array:
    values = as_vector(ratio, "damping_ratio", positive=False)
    if values.size not in (1, count):
        raise ct.ControlDimension(
            f"damping_ratio has {values.size} entries, expected 1 or one per mode ({count})"
        )
    return values


def _modal_damping(M: Array, K: Array, ratio: Any) -> Array:
    values = _ratios(ratio, M.shape[0])
    squared, modes = eigh(K, M)
    if squared[0] < -1e-9 * np.abs(squared).max():
        raise ModelError(
            f"K has a negative direction (omega^2 = {squared[0]:g}), so damping ratios mean nothing; give C"
        )
    omega = np.sqrt(np.maximum(squared, 0.0))
    shape = M @ modes
    damping = shape @ np.diag(2.0 * values * omega) @ shape.T
    return np.asarray((damping + damping.T) / 2)


def _found_links(K: Array, C: Array) -> tuple[list[Place], dict[tuple[int, ...], str]]:
    """A place for each pair that a spring or a damper joins."""
    n = K.shape[0]
    places: list[Place] = []
    pairs: dict[tuple[int, ...], str] = {(i,): f"mass{i + 1}" for i in range(n)}
    for i, j in combinations(range(n), 2):
        joined = any(abs(X[i, j]) > 1e-12 * np.sqrt(abs(X[i, i] * X[j, j])) for X in (K, C) if X[i, j])
        if joined:
            label = f"mass{i + 1}-mass{j + 1}"
            words = f"between displacements {i + 1} and {j + 1} (d = q{i + 1} - q{j + 1})"
            places.append(Place(label, unit_vector(n, (i, 1.0), (j, -1.0)), words, absolute=False))
            pairs[i, j] = label
    return places, pairs


def _named_links(links: Mapping[str, Any], n: int) -> tuple[list[Place], dict[tuple[int, ...], str]]:
    """Places that the user named."""
    places: list[Place] = []
    pairs: dict[tuple[int, ...], str] = {(i,): f"mass{i + 1}" for i in range(n)}
    joined: set[tuple[int, ...]] = set()
    if not isinstance(links, Mapping):
        raise ct.ControlArgument(f'links must be a mapping such as {{"brace": (1, 3)}}, not {links!r}')
    for label, ends in links.items():
        if not isinstance(label, str) or not label or label in [f"mass{i + 1}" for i in range(n)]:
            raise ModelError(f"a link cannot be named {label!r}; mass1, mass2, ... are the masses")
        if isinstance(ends, np.ndarray):
            if ends.shape != (n,) or not np.isfinite(ends).all() or not ends.any():
                raise ct.ControlDimension(f"link {label!r} must be a finite, nonzero vector of length {n}")
            places.append(Place(label, ends.astype(float), "d = g @ q with the given vector", absolute=False))
            continue
        entries = _ends(label, ends, n)
        key = tuple(sorted(i for i, _ in entries))
        if key in joined:
            raise ModelError(f"links {pairs[key]!r} and {label!r} join the same ends; give one")
        joined.add(key)
        pairs[key] = label
        words = " - ".join(f"q{i + 1}" for i, _ in entries)
        places.append(Place(label, unit_vector(n, *entries), f"link with d = {words}", absolute=False))
    return places, pairs


def _ends(label: str, ends: Any, n: int) -> list[tuple[int, float]]:
    """Masses at the ends of a link with their signs; the ground has none."""
    if not isinstance(ends, Sequence) or len(ends) != 2:
        raise ct.ControlArgument(
            f"link {label!r} must be a pair such as (1, 2), with 0 for the ground, not {ends!r}"
        )
    numbers = [None if end == 0 else as_index(end, f"an end of link {label!r}", n) for end in ends]
    if numbers[0] is None or numbers[0] == numbers[1]:
        raise ModelError(f"link {label!r} = {ends!r} must start at a mass and end elsewhere")
    return [(i, sign) for i, sign in zip(numbers, (1.0, -1.0), strict=True) if i is not None]


def _link_parameters(
    M: Array, C: Array, K: Array, pairs: Mapping[tuple[int, ...], str], units: Units
) -> list[NominalParameter]:
    """Return masses if M is diagonal, and springs and dampers with a place."""
    n = M.shape[0]
    found: list[NominalParameter] = []
    if not np.any(M - np.diag(np.diag(M))):
        found += [
            NominalParameter(f"m{i + 1}", float(M[i, i]), units.coefficient("mass"), "mass", f"mass{i + 1}")
            for i in range(n)
        ]
    for letter, kind, X in (("c", "damping", C), ("k", "stiffness", K)):
        for key, place in pairs.items():
            value = -X[key] if len(key) == 2 else X[key[0]].sum()
            if abs(value) > 1e-12 * np.abs(X).max(initial=0.0):
                label = f"{letter}[{place}]"
                found.append(NominalParameter(label, float(value), units.coefficient(kind), kind, place))
    return found
