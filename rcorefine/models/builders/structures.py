"""Structures: chains of masses, and mass and stiffness matrices."""

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

from ...arguments import as_array
from ...exceptions import ModelError
from ...systems.linear import Array
from ..parameters import NominalParameter
from ..physical_model import PhysicalModel
from ..ports import row_of
from ._assembly import (
    BuilderArguments,
    InputMap,
    Place,
    Units,
    assembled,
    input_map,
    parse_sensors,
    second_order,
    units_of,
)
from ._equations import as_index, as_vector

Names = dict[tuple[int, ...], str]  # places by the numbers of their masses
_SHIFT = 1e-8  # shift below zero over the median of K_ii / M_ii
_DENSE = 200  # displacements up to which a dense solver is as fast
_SAME = 1e-6  # relative difference of squared frequencies that is rounding


def mass_spring_damper(
    m: float | Sequence[float],
    c: float | Sequence[float],
    k: float | Sequence[float],
    *,
    excitation: str = "force",
    force: int | Sequence[int] | Array | None = None,
    sensors: Any = "displacement",
    inputs: str | Sequence[str] | None = None,
    outputs: str | Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    position_unit: str = "m",
    force_unit: str = "N",
    name: str = "chain",
) -> PhysicalModel:
    """Chain of masses on springs and dampers.

    Parameters
    ----------
    m : float or sequence of n floats
        Masses [kg], positive.
    c : float or sequence of n or n+1 floats
        Dampers [N s/m], not negative: the first joins mass 1 to the
        ground, entry n+1 (if given) mass n to the ground.
    k : float or sequence of n or n+1 floats
        Springs [N/m], in the same order. With n entries in both the far end is free.
    excitation : {"force", "base"}, optional
        ``"base"`` makes the acceleration of the base [m/s^2] the first input; the
        states are then relative to the base.
    force : int, sequence of int or ndarray of shape (n, n_w), optional
        Masses that a force acts on, counted from 1, one input each; default mass 1
        (none under base excitation). A 2-D array tells how each input acts on the
        masses.
    sensors : str, tuple or list, optional
        ``"velocity"`` measures all masses, ``("velocity", 1)`` the first,
        ``("velocity", (1, 3))`` two of them, ``("displacement", "link2")`` an
        elongation, ``("force", "link2")`` what its spring and damper hold, and with them whatever
        else is missing there: a load cell; a list of these measures them all, in order. Under base
        excitation accelerations of masses are absolute, the others
        are relative to the base.
    inputs, outputs, states : str or sequence of str, optional
        Labels; default ``"force"`` or ``"base_acceleration"``, ``"q1"``, ``"v1"``, ``"a1"``
        by quantity and mass, and states ``q1..qn, v1..vn``.
    position_unit, force_unit : str, optional
        Units to print.
    name : str, optional
        Name of the system.

    Returns
    -------
    PhysicalModel
        Model with the ports ``link1..link{n}`` (or ``link{n+1}``) and ``mass1..mass{n}``.

    Raises
    ------
    control.ControlDimension
        If `c`, `k` or labels have the wrong number of entries.
    ModelError
        If a mass is not positive, a spring or damper negative, or a mass does not exist.

    Notes
    -----
    ``link1`` joins the ground to mass 1 (d = q_1), ``link{i}`` mass i-1 to mass i
    (d = q_i - q_(i-1), its elongation), ``link{n+1}`` mass n to the ground, taken in the sense
    of mass n (d = q_n). The equations are (49)-(51) of the paper.

    Examples
    --------
    >>> model = mass_spring_damper([0.8, 0.5], [100, 200, 120], [1000, 1500, 2000],
    ...                            sensors=("velocity", 1))
    >>> [port.name for port in model.ports]
    ['link1', 'link2', 'link3', 'mass1', 'mass2']
    >>> model.system.C
    array([[0., 0., 1., 0.]])
    """
    # masses, dampers and springs; n or n + 1 links
    masses = as_vector(m, "m")
    n = masses.size
    given = {"c": as_vector(c, "c", positive=False), "k": as_vector(k, "k", positive=False)}
    for key, values in given.items():
        if values.size not in (n, n + 1):
            raise ct.ControlDimension(
                f"{key} has {values.size} entries for {n} masses; give {n} (the far end is free) or {n + 1} "
                "(the last joins the last mass to the ground)"
            )
    # without a link at the far end, its damper and spring are zero
    count = max(values.size for values in given.values())
    damping, stiffness = (np.pad(values, (0, count - values.size)) for values in given.values())
    # places: links between neighbors, then the masses themselves
    links = [_chain_link(n, i) for i in range(count)]
    points = _points(n, "mass")
    units = units_of(position_unit, force_unit)
    options = BuilderArguments(excitation, "force", force, sensors, units, (inputs, outputs, states, name))
    # nominal parameters at their places
    parameters = [
        NominalParameter(f"{letter}{i + 1}", value, options.units[kind], kind, place.name)
        for letter, kind, values, places in (
            ("m", "mass", masses, points),
            ("c", "damping", damping, links),
            ("k", "stiffness", stiffness, links),
        )
        for i, (value, place) in enumerate(zip(values.tolist(), places, strict=True))
    ]
    # elongations d = G q: C = G' diag(c) G, K = G' diag(k) G
    G = np.array([link.direction for link in links])
    structure = np.diag(masses), G.T @ np.diag(damping) @ G, G.T @ np.diag(stiffness) @ G
    return assembled(structure, [*links, *points], parameters, options)


def _points(n: int, what: str) -> list[Place]:
    """Return the places of the masses themselves."""
    return [
        Place(f"mass{i + 1}", row, f"{what} {i + 1} itself (d = q{i + 1})", True)
        for i, row in enumerate(np.eye(n))
    ]


def _chain_link(n: int, i: int) -> Place:
    """Elongation of link i + 1 of a chain of n masses."""
    # d = q_(i+1) - q_i; the ground has no coordinate
    row = row_of(n, {min(i, n - 1): 1.0} | ({i - 1: -1.0} if 0 < i < n else {}))
    if i == 0:
        words = "between the ground and mass 1 (d = q1)"
    elif i < n:
        words = f"between mass {i} and mass {i + 1} (d = q{i + 1} - q{i})"
    else:
        words = f"between mass {n} and the ground (d = q{n})"
    return Place(f"link{i + 1}", row, f"spring and damper {words}", False)


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
        F as a matrix, or the numbers (from 1) of the displacements that a force acts on;
        default 1 (none under base excitation). An input has the unit `force_unit` if its column of F has
        only 0, 1 and -1. Otherwise its unit is not known: through [[0.02]], in N m/V, it is a voltage.
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
    units = units_of(position_unit, force_unit)
    options = BuilderArguments(
        excitation, "force_map", force_map, sensors, units, (inputs, outputs, states, name)
    )
    # n numbers make a diagonal mass matrix
    if not issparse(M):
        M = np.atleast_1d(as_array(M, "M", error=ModelError))
        M = diags(as_vector(M, "M"), format="csc") if M.ndim == 1 else M
    n = M.shape[0]
    # full matrices without `n_modes`, sparse ones with it
    whole = n_modes is None
    mass = _matrix(M, "M", n, whole)
    stiffness = _matrix(csc_matrix((n, n)) if K is None else K, "K", n, whole)
    damping = None if C is None else _matrix(C, "C", n, whole, symmetric=False)
    if C is not None and damping_ratio is not None:
        raise ct.ControlArgument("give C or damping_ratio, not both")
    # finite elements: keep the lowest modes only
    if not whole:
        count = as_index(n_modes, "n_modes", n) + 1
        return _by_modes((mass, damping, stiffness), count, damping_ratio, links, options)
    # M is positive definite if its smallest eigenvalue is positive
    smallest = float(np.linalg.eigvalsh(mass)[0])
    if smallest <= 0:
        raise ModelError(
            f"M must be positive definite, its smallest eigenvalue is {smallest:g}; "
            "every displacement needs a mass"
        )
    # a damping matrix that is not symmetric (gyroscopic forces) is no sum of dampers
    nothing = np.zeros((n, n))
    listed = nothing if damping is None or not np.allclose(damping, damping.T) else damping
    if damping is None:
        damping = nothing if damping_ratio is None else _modal_damping(mass, stiffness, damping_ratio)
    # places: coupled pairs or those of the user, then the displacements themselves
    places, pairs = _coupled_links(stiffness, listed) if links is None else _user_links(links, n)
    points = _points(n, "displacement")
    names = {(i,): point.name for i, point in enumerate(points)} | pairs
    parameters = _link_parameters(mass, listed, stiffness, names, options.units)
    return assembled((mass, damping, stiffness), [*places, *points], parameters, options)


def _matrix(value: Any, name: str, size: int, dense: bool, *, symmetric: bool = True) -> Any:
    """Return a square matrix of finite numbers, sparse unless `dense`."""
    # sparse matrices: only the entries that are stored
    sparse = issparse(value)
    if sparse and not dense:
        if value.dtype.kind not in "fiu":
            raise ct.ControlArgument(f"{name} must hold real numbers, not {value.dtype}")
        matrix = csc_matrix(value, dtype=float)
        if not np.isfinite(matrix.data).all():
            raise ModelError(f"{name} has a value that is not finite")
    else:
        matrix = np.atleast_2d(as_array(value.toarray() if sparse else value, name, error=ModelError))
    if matrix.shape != (size, size):
        raise ct.ControlDimension(f"{name} has shape {matrix.shape}, expected {(size, size)}")
    if symmetric and sparse and not dense and abs(matrix - matrix.T).max() > 1e-8 * abs(matrix).max():
        raise ModelError(
            f"{name} is not symmetric; a Matrix Market file that holds a half must say `symmetric`"
        )
    if isinstance(matrix, np.ndarray):
        # symmetric within rounding
        if symmetric and not np.allclose(matrix, matrix.T, rtol=1e-8, atol=1e-10 * np.abs(matrix).max()):
            i, j = np.unravel_index(np.argmax(np.abs(matrix - matrix.T)), matrix.shape)
            raise ModelError(
                f"{name} is not symmetric: {name}[{i}, {j}] = {matrix[i, j]:g}, but "
                f"{name}[{j}, {i}] = {matrix[j, i]:g}; by action and reaction they are equal"
            )
    return matrix if dense else csc_matrix(matrix)


def _by_modes(
    structure: tuple[Any, Any, Any], r: int, ratio: Any, links: Any, options: BuilderArguments
) -> PhysicalModel:
    """Return a model that consists of the lowest r modes of a structure.

    Its sensors, forces and named links are projected on the modes.
    """
    M, C, K = structure
    n = M.shape[0]
    # modal coordinates: q = Phi eta, Phi' M Phi = I, Phi' K Phi = diag(omega^2)
    squares, shapes = _lowest_modes(M, K, r)
    # Phi' C Phi, or 2 zeta omega on the diagonal
    damping = np.zeros((r, r)) if C is None else shapes.T @ (C @ shapes)
    if ratio is not None:
        damping = np.diag(2.0 * _ratios(ratio, r) * np.sqrt(squares))
    places = [] if links is None else _user_links(links, n)[0]
    # inputs, sensors and links of the structure, projected on the modes
    drive = input_map(options, M)
    found = parse_sensors(options, n, {place.name: place for place in places}, drive.base)
    sensors = {label: sensor._replace(motion=sensor.motion @ shapes) for label, sensor in found.items()}
    modes = [
        Place(f"mode{i + 1}", row, f"mode of {np.sqrt(w2):.4g} rad/s", False)
        for i, (row, w2) in enumerate(zip(np.eye(r), squares, strict=True))
    ]
    own = [place._replace(direction=place.direction @ shapes) for place in places]
    # nominal parameters of each mode: damping 2 zeta omega, stiffness omega^2
    parameters = [
        NominalParameter(f"{kind[0]}[{mode.name}]", float(value), "", kind, mode.name)
        for kind, values in (("damping", np.diag(damping)), ("stiffness", squares))
        for mode, value in zip(modes, values, strict=True)
    ]
    # the mass matrix is the identity
    modal = np.eye(r), damping, np.diag(squares)
    drive = InputMap(shapes.T @ drive.force, 0.0 * drive.base, drive.inputs)
    model = second_order(modal, drive, [*own, *modes], sensors, parameters, options, ("eta", "deta"))
    # modal coordinates have no physical unit
    ports = [
        replace(port, modal=True, position_unit="", velocity_unit="", force_unit="")
        for port in model.ports[len(own) :]
    ]
    return replace(model, ports=(*model.ports[: len(own)], *ports), state_units=("",) * (2 * r))


def _lowest_modes(M: csc_matrix, K: csc_matrix, count: int) -> tuple[Array, Array]:
    """Return squared frequencies and mode shapes, the lowest first.

    Their shapes are (count,) and (n, count), and Phi' M Phi = I.

    Raises
    ------
    ModelError
        If M is not positive definite, K has a negative direction, or modes cannot be told from others.
    """
    n = M.shape[0]
    # no negative pivots: M is positive definite
    if M.diagonal().min() <= 0 or _negative(M):
        raise ModelError("M must be positive definite: every displacement needs a mass")
    # shift just below zero, since rigid-body modes make K singular
    middle = float(np.median(np.abs(K.diagonal()) / M.diagonal())) or 1.0
    shift = -_SHIFT * middle
    # small structures: dense generalized eigenvalue problem
    if n <= _DENSE or 2 * count >= n:
        squares, shapes = eigh(K.toarray(), M.toarray(), subset_by_index=[0, count - 1])
    else:
        squares, shapes = _by_lanczos(M, K, count, shift)
    if squares[0] < shift:
        raise ModelError(
            f"K has a negative direction (omega^2 = {squares[0]:g}); the structure would not stand"
        )
    # rigid-body modes: exactly zero
    squares = np.where(np.abs(squares) <= _SAME * abs(shift), 0.0, squares)
    # the largest entry of each mode shape is positive
    shapes = shapes * np.sign(shapes[np.argmax(np.abs(shapes), axis=0), np.arange(count)])
    return squares, shapes


def _by_lanczos(M: csc_matrix, K: csc_matrix, count: int, shift: float) -> tuple[Array, Array]:
    """Return the lowest modes by shift-and-invert Lanczos iteration.

    The shift lies below zero, because rigid-body modes make K itself singular.
    """
    # negative pivots count the eigenvalues below the shift (Sylvester's law of inertia)
    solved = _factors(K - shift * M)
    if (solved.U.diagonal() < 0).any():
        raise ModelError("K has a negative direction; the structure would not stand")
    # Lanczos iteration on (K - shift M)^-1 M
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
    # check: the number of modes below the last one, by Sylvester's law of inertia
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


def _ratios(ratio: Any, count: int) -> Array:
    values = as_vector(ratio, "damping_ratio", positive=False)
    if values.size not in (1, count):
        raise ct.ControlDimension(
            f"damping_ratio has {values.size} entries, expected 1 or one per mode ({count})"
        )
    return values


def _modal_damping(M: Array, K: Array, ratio: Any) -> Array:
    # modes with Phi' M Phi = I
    values = _ratios(ratio, M.shape[0])
    squared, modes = eigh(K, M)
    if squared[0] < -1e-9 * np.abs(squared).max():
        raise ModelError(
            f"K has a negative direction (omega^2 = {squared[0]:g}), so damping ratios mean nothing; give C"
        )
    # C = M Phi diag(2 zeta omega) Phi' M
    shape = M @ modes
    damping = shape @ np.diag(2.0 * values * np.sqrt(np.maximum(squared, 0.0))) @ shape.T
    # exactly symmetric
    return np.asarray((damping + damping.T) / 2)


def _coupled_links(K: Array, C: Array) -> tuple[list[Place], Names]:
    """Return a place for each coupled pair, and names by pair."""
    n = K.shape[0]
    places: list[Place] = []
    names: Names = {}
    for i, j in combinations(range(n), 2):
        # coupled, relative to the diagonal entries
        if any(abs(X[i, j]) > 1e-12 * np.sqrt(abs(X[i, i] * X[j, j])) for X in (K, C) if X[i, j]):
            names[i, j] = f"mass{i + 1}-mass{j + 1}"
            words = f"between displacements {i + 1} and {j + 1} (d = q{i + 1} - q{j + 1})"
            places.append(Place(names[i, j], row_of(n, {i: 1.0, j: -1.0}), words, False))
    return places, names


def _user_links(links: Any, n: int) -> tuple[list[Place], Names]:
    """Places that the user named, and names by mass or pair."""
    places: list[Place] = []
    joined: Names = {}
    if not isinstance(links, Mapping):
        raise ct.ControlArgument(f'links must be a mapping such as {{"brace": (1, 3)}}, not {links!r}')
    for label, ends in links.items():
        if not isinstance(label, str) or not label or label in [f"mass{i + 1}" for i in range(n)]:
            raise ModelError(f"a link cannot be named {label!r}; mass1, mass2, ... are the masses")
        # a vector g: d = g q
        if isinstance(ends, np.ndarray):
            if ends.shape != (n,) or not np.isfinite(ends).all() or not ends.any():
                raise ct.ControlDimension(f"link {label!r} must be a finite, nonzero vector of length {n}")
            places.append(Place(label, ends.astype(float), "d = g @ q with the given vector", False))
            continue
        entries = _ends(label, ends, n)
        # two places must not have the same ends
        key = tuple(sorted(entries))
        if key in joined:
            raise ModelError(f"links {joined[key]!r} and {label!r} join the same ends; give one")
        joined[key] = label
        words = " - ".join(f"q{i + 1}" for i in entries)
        places.append(Place(label, row_of(n, entries), f"link with d = {words}", False))
    return places, joined


def _ends(label: str, ends: Any, n: int) -> dict[int, float]:
    """Masses at the ends of a link with their signs; the ground has none."""
    if not isinstance(ends, Sequence) or len(ends) != 2:
        raise ct.ControlArgument(
            f"link {label!r} must be a pair such as (1, 2), with 0 for the ground, not {ends!r}"
        )
    one, two = (None if end == 0 else as_index(end, f"an end of link {label!r}", n) for end in ends)
    if one is None or one == two:
        raise ModelError(f"link {label!r} = {ends!r} must start at a mass and end elsewhere")
    return {one: 1.0} if two is None else {one: 1.0, two: -1.0}


def _link_parameters(M: Array, C: Array, K: Array, names: Names, units: Units) -> list[NominalParameter]:
    """Return masses if M is diagonal, and springs and dampers with a place."""
    found: list[NominalParameter] = []
    # masses only of a diagonal mass matrix
    if not np.any(M - np.diag(np.diag(M))):
        found += [
            NominalParameter(f"m{i + 1}", float(mass), units["mass"], "mass", f"mass{i + 1}")
            for i, mass in enumerate(np.diag(M))
        ]
    for kind, X in (("damping", C), ("stiffness", K)):
        letter = "k" if kind == "stiffness" else "c"
        for key, place in names.items():
            # spring between a pair: -K_ij; to the ground: sum of row i
            value = -X[key] if len(key) == 2 else X[key[0]].sum()
            if abs(value) > 1e-12 * np.abs(X).max(initial=0.0):
                found.append(NominalParameter(f"{letter}[{place}]", float(value), units[kind], kind, place))
    return found
