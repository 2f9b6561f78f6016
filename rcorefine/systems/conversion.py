"""Continuous to discrete time and back, canonical form, nearest models."""

from __future__ import annotations

import math

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ..arguments import as_choice
from ..exceptions import ConversionWarning, ModelError, warn
from .discretization import balanced, check_sampling_time, discretize, power_of_two
from .linear import Array, LinearModel, balance

# Two sampling times that agree this well are the same (time columns are rounded).
SAME_DT = 1e-6
# Angle of a discrete pole, as a fraction of pi, beyond which aliasing is suspected.
DOUBTFUL_ANGLE = 0.9
# Relative error of a matrix logarithm above which a warning is given.
LOG_TOLERANCE = 1e-8
_EPS = float(np.finfo(float).eps)
_FAST = 0.02  # substitute for a pole without a real logarithm: decays within two samples, can be inverted
_REAL = 1e-5  # imaginary part over size below which a pole counts as real: multiple ones split by rounding
_ZERO = 1e-4  # size below which a pole counts as zero


def to_discrete(model: LinearModel, dt: float, hold: str = "zoh") -> LinearModel:
    """Return the discrete model for a record sampled every `dt` seconds.

    Parameters
    ----------
    model : LinearModel
        Continuous model (``dt = 0``, it is discretized exactly), discrete
        model (kept as it is), or a model without a definite timebase
        (``dt = True`` or ``None``, it takes over the record's).
    dt : float
        Sampling time of the record in seconds.
    hold : {'zoh', 'foh'}, optional
        How the input moves between samples; matters for continuous models
        only. With 'foh' the state is shifted by a multiple of the input,
        ``x - G1 w``, so that the model keeps the usual form.

    Returns
    -------
    LinearModel
        Discrete model with sampling time `dt`, labels and name kept.

    Raises
    ------
    ModelError
        If the model has another sampling time, or `dt` is not positive.

    Examples
    --------
    >>> import control as ct
    >>> from rcorefine.systems.linear import LinearModel
    >>> integrator = LinearModel.from_statespace(ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]]))
    >>> print(to_discrete(integrator, 0.5).B)
    [[0.5]]
    """
    step = check_sampling_time(dt)
    if model.dt is None or model.dt is True:
        return model.with_arrays(dt=step)
    if model.is_continuous:
        # first-order hold: the state x - G1 w removes w(k+1) from the recursion
        phi, g0, g1 = discretize(model.A, model.B, step, hold)
        return model.with_arrays(A=phi, B=g0 + phi @ g1, C=model.C.copy(), D=model.D + model.C @ g1, dt=step)
    if not math.isclose(model.dt, step, rel_tol=SAME_DT):
        raise ModelError(
            f"model {model.name!r} has dt = {model.dt:g} s but the record has dt = {step:g} s; "
            "resample the record, or give the continuous model (rcorefine.d2c converts one)"
        )
    return model.with_arrays(dt=step)


def d2c(system: ct.StateSpace, method: str = "zoh") -> ct.StateSpace:
    """Convert a discrete model to continuous time.

    The inverse of ``system.sample(dt, method)``; labels and name are kept.
    With 'zoh' the block matrix logarithm is taken, which also holds where
    the continuous state matrix is singular (integrators), unlike the
    reverse of the paper's equation (20).

    Parameters
    ----------
    system : StateSpace
        Discrete model with a definite sampling time, ``dt > 0``.
    method : {'zoh', 'tustin'}, optional
        How the discrete model came about: exactly, its input held between
        samples (zero-order hold), or by the bilinear transformation.

    Returns
    -------
    StateSpace
        Continuous model (``dt = 0``).

    Raises
    ------
    control.ControlArgument
        If `system` is not a `StateSpace` or `method` is unknown.
    ModelError
        If `system` is continuous already or has no definite sampling time,
        if no continuous model has these samples (a pole at zero, as delays
        have; a real negative pole, whose logarithm is complex), or, with
        'tustin', if there is a pole at -1.

    Warns
    -----
    ConversionWarning
        With 'zoh', if a pole lies so near the negative real axis that its
        frequency is above 0.9 of the Nyquist frequency ``pi / dt``.

    Notes
    -----
    *What can be detected about aliasing, and what cannot.* A mode at the
    frequency ``omega`` and modes at ``2 pi k / dt +- omega`` have the same
    discrete pole. The conversion gives the slowest of them, the only one
    with ``omega < pi / dt``. A model that was sampled too slowly, with a
    mode well above Nyquist, thus comes back with that mode folded below
    it, and nothing in the discrete model betrays it. Only a pole on the
    negative real axis or near it can be seen, and is warned about: it is
    where a mode crosses Nyquist. Compare the frequencies found with
    what is known of the plant, or sample faster.

    'tustin' is one to one (it maps the whole left half plane onto the
    unit disk), so there is nothing to warn about; but its frequencies are
    warped, ``omega = (2 / dt) tan(omega_d dt / 2)``.

    Examples
    --------
    >>> import control as ct
    >>> import rcorefine as rco
    >>> plant = ct.ss([[0.0, 1.0], [0.0, -2.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]], name="motor")
    >>> back = rco.d2c(plant.sample(0.1, name="motor"))
    >>> print(back.name, back.dt, abs(back.A - plant.A).max() < 1e-12)
    motor 0 True
    """
    as_choice(method, "method", ("zoh", "tustin"))
    if isinstance(system, ct.TransferFunction):
        raise ct.ControlArgument(
            "d2c takes a control.StateSpace, not a TransferFunction; use control.ss(...)"
        )
    model = LinearModel.from_statespace(system)
    where = f"system {model.name!r}"
    if model.is_continuous:
        raise ModelError(f"{where} is continuous already (dt = 0); d2c takes a discrete model")
    if model.dt is None or model.dt is True:
        raise ModelError(
            f"{where} has no definite sampling time (dt = {model.dt}); "
            "give it one, as in control.ss(A, B, C, D, 0.01)"
        )
    step = check_sampling_time(model.dt)
    if model.n_states == 0:
        return model.with_arrays(dt=0).to_statespace()
    if method == "tustin":
        return _inverse_tustin(model, step, where).to_statespace()
    a, b = _inverse_hold(model.A, model.B, step, where)
    return model.with_arrays(A=a, B=b, dt=0).to_statespace()


def _inverse_hold(phi: Array, gamma: Array, step: float, where: str) -> tuple[Array, Array]:
    """Continuous A and B from the block logarithm of a zero-order hold model."""
    n, n_w = gamma.shape
    # balance the states and scale the inputs, both by powers of two
    phi, scale = balanced(phi)
    gamma = gamma / scale[:, None]
    columns = power_of_two(np.max(np.abs(gamma), axis=0, initial=0.0))
    _check_poles(phi, step, where)
    # log [Phi Gamma; 0 I] = [A B; 0 0] dt
    block = np.eye(n + n_w)
    block[:n, :n], block[:n, n:] = phi, gamma / columns
    principal = _logarithm(block)
    size = float(np.max(np.abs(principal)))
    if not np.isfinite(size) or float(np.max(np.abs(principal.imag))) > 1e-6 * size:
        raise ModelError(
            f"{where} has no real logarithm, so no continuous model has these samples exactly; "
            "check the model, or use method='tustin'"
        )
    log: Array = principal.real
    # check: the exponential must give the samples back
    mismatch = float(np.max(np.abs(linalg.expm(log) - block))) / float(np.max(np.abs(block)))
    if not mismatch < LOG_TOLERANCE:
        warn(
            f"{where} converts to continuous time with a relative error of {mismatch:.1g} only, because its "
            "A is nearly singular or far from normal; sample faster, or remove states without effect",
            ConversionWarning,
        )
    log = log / step
    return log[:n, :n] * scale[:, None] / scale, log[:n, n:] * scale[:, None] * columns


def _logarithm(matrix: Array) -> NDArray[np.complex128]:
    """Principal logarithm by inverse scaling and squaring.

    `scipy.linalg.logm` draws from the global random numbers, which a
    conversion must not do.
    """
    # Schur form; square roots until it is close to the identity
    triangle, unitary = linalg.schur(matrix, output="complex")
    exact = np.log(np.diag(triangle))
    identity = np.eye(len(matrix))
    squarings = 0
    while np.linalg.norm(triangle - identity, 1) > 0.25 and squarings < 100:
        triangle = linalg.sqrtm(triangle)
        squarings += 1
    deviation = np.array(triangle - identity)
    np.fill_diagonal(deviation, np.expm1(exact / 2.0**squarings))
    # log(I + X) = integral of X (I + s X)^-1 over [0, 1], to rounding with 12 nodes.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    log = np.zeros_like(deviation)
    for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        log += weight * linalg.solve_triangular(identity + node * deviation, deviation)
    log *= 2.0**squarings
    np.fill_diagonal(log, exact)
    return np.asarray(unitary @ log @ unitary.conj().T, dtype=np.complex128)


def _check_poles(phi: Array, step: float, where: str) -> None:
    """Reject poles without a real logarithm.

    Warn where the branch of the logarithm is in doubt.
    """
    # a zero pole or a real negative one has no real logarithm
    poles = linalg.eigvals(phi)
    sizes = linalg.svdvals(phi)
    if sizes[-1] <= len(poles) * _EPS * sizes[0]:
        raise ModelError(
            f"{where} has a pole at zero (smallest singular value of A {sizes[-1]:.1g}): a delay, or "
            f"a mode that dies out within one sample of {step:g} s. No continuous model has it; remove "
            "the state, sample faster, or use method='tustin'"
        )
    angles = np.abs(np.angle(poles))
    negative = (poles.real < 0) & (np.abs(poles.imag) <= _EPS * len(poles) * sizes[0])
    if negative.any():
        raise ModelError(
            f"{where} has a pole at {poles[negative][0].real:.4g}: a real negative pole has no real "
            f"logarithm, so no continuous model of this order has it. Its motion changes sign every "
            f"sample, at the Nyquist frequency {math.pi / step:.4g} rad/s; sample faster, or use "
            "method='tustin'"
        )
    doubtful = angles > DOUBTFUL_ANGLE * math.pi
    if doubtful.any():
        frequency = float(angles[doubtful].max()) / step
        warn(
            f"{where} has a mode at {frequency:.4g} rad/s, close to the Nyquist frequency "
            f"{math.pi / step:.4g} rad/s; if the mode really lies above it, the continuous model "
            "is wrong (aliasing). Sample faster to be sure",
            ConversionWarning,
        )


def _inverse_tustin(model: LinearModel, step: float, where: str) -> LinearModel:
    """Invert the bilinear transformation as `StateSpace.sample` applies it."""
    # z = (1 + s dt / 2) / (1 - s dt / 2), solved for s
    identity = np.eye(model.n_states)
    phi, scale = balanced(model.A)
    b, c = model.B / scale[:, None], model.C * scale
    resolvent = (phi + identity) / 2  # (I - A_c step / 2)^-1
    sizes = linalg.svdvals(resolvent)
    if sizes[-1] <= model.n_states * _EPS * max(1.0, float(sizes[0])):
        raise ModelError(
            f"{where} has a pole at -1, which the bilinear transformation sends to infinity; "
            "no continuous model has it. Use another sampling time"
        )
    # A = (Phi + I)^-1 (Phi - I) 2 / dt, and B, C, D accordingly
    inverse = np.linalg.inv(resolvent)
    a = np.linalg.solve(resolvent, phi - identity) / step
    c = c @ inverse
    return model.with_arrays(
        A=a * scale[:, None] / scale,
        B=(np.linalg.solve(resolvent, b) / step) * scale[:, None],
        C=c / scale,
        D=model.D - c @ b / 2,
        dt=0,
    )


def nearest_continuous(model: LinearModel) -> LinearModel:
    """Return the exact or the nearest continuous model of a discrete one.

    The exact one has the same samples. Where there is none, the nearest of the same order is returned. Real
    poles that are negative or zero have no real logarithm. They are moved to z = 0.02, where the mode dies
    out as fast as sampling shows, and the static gain is kept.

    Parameters
    ----------
    model : LinearModel
        Discrete model with a definite sampling time.

    Returns
    -------
    LinearModel
        Continuous model.

    Warns
    -----
    ConversionWarning
        If poles had to be moved: which, and where to.

    Examples
    --------
    >>> import warnings
    >>> import control as ct
    >>> from rcorefine.systems.linear import LinearModel
    >>> odd = LinearModel.from_statespace(ct.ss([[-0.9]], [[1.0]], [[1.0]], [[0.0]], 0.1))
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore")
    ...     near = nearest_continuous(odd).to_statespace()
    >>> bool(np.isclose(near.dcgain(), odd.to_statespace().dcgain()))
    True
    """
    moved, poles = _move_bad_poles(model)
    if poles.size:
        shown = ", ".join(f"{pole:.4g}" for pole in poles[:4].real)
        warn(
            f"system {model.name!r} has no continuous model of its order: pole(s) at {shown} have no real "
            f"logarithm. They were moved to z = {_FAST:g}, the static gain kept; discrete_system is exact",
            ConversionWarning,
        )
    try:
        return LinearModel.from_statespace(d2c(moved.to_statespace()))
    except ModelError as error:
        if not poles.size:
            warn(
                f"{error}. The bilinear transformation was taken instead; discrete_system is exact",
                ConversionWarning,
            )
        return LinearModel.from_statespace(d2c(moved.to_statespace(), method="tustin"))


def _move_bad_poles(model: LinearModel) -> tuple[LinearModel, Array]:
    """Model with poles without a real logarithm moved, and those poles.

    The model is split in two invariant subspaces (ordered Schur form and a Sylvester equation), so
    that multiple poles do no harm.
    """

    def bad(real: float, imaginary: float) -> bool:
        size = abs(complex(real, imaginary))
        return size < _ZERO or (real <= 0 and abs(imaginary) <= _REAL * size)

    units = balance(model.A)  # units of the user may differ by orders of magnitude
    # ordered Schur form: the bad poles first
    triangle, basis, count = linalg.schur(model.A * units / units[:, None], output="real", sort=bad)
    if count == 0:
        return model, np.zeros(0)
    poles = linalg.eigvals(triangle[:count, :count])
    # Sylvester equation: block diagonal form of both subspaces
    first, coupling, rest = triangle[:count, :count], triangle[:count, count:], triangle[count:, count:]
    apart = linalg.solve_sylvester(first, -rest, -coupling)
    n = model.n_states
    split = np.eye(n)
    split[:count, count:] = apart
    basis = basis @ split  # columns: the bad subspace, then the good one
    basis, back = units[:, None] * basis, linalg.inv(basis) / units
    gain = back[:count] @ model.B
    # the static response of the moved modes stays: (1 - z) (I - A1)^-1 B1
    gain = (1.0 - _FAST) * linalg.solve(np.eye(count) - first, gain)
    # bad modes with the pole z = 0.02, the others as they were
    A = basis @ linalg.block_diag(_FAST * np.eye(count), rest) @ back
    B = basis @ np.vstack([gain, back[count:] @ model.B])
    return model.with_arrays(A=A, B=B), poles


def growth(model: LinearModel) -> float:
    """Return the largest growth rate of the modes.

    It is the largest real part of the poles. For a discrete model it is the largest logarithm of their
    magnitude.
    """
    if model.n_states == 0:
        return -np.inf
    poles = linalg.eigvals(model.A)
    if model.is_continuous:
        return float(poles.real.max())
    with np.errstate(divide="ignore"):
        return float(np.log(np.abs(poles).max()))


def stabilized(model: LinearModel, limit: float) -> LinearModel:
    """Return a model whose modes grow no faster than `limit`.

    Modes that grow faster are slowed down by the same amount, the fastest one to the limit. The others stay,
    unless rounding errors hide on which side of the limit a mode is. Then all slow down.

    Parameters
    ----------
    model : LinearModel
        Continuous or discrete model.
    limit : float
        Largest growth, as of `growth`.

    Returns
    -------
    LinearModel
        The same model where nothing grows faster.

    Examples
    --------
    >>> import control as ct
    >>> from rcorefine.systems.linear import LinearModel
    >>> wild = ct.ss([[0.1, 1.0], [0.0, -2.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    >>> wild = LinearModel.from_statespace(wild)
    >>> linalg.eigvals(stabilized(wild, -0.5).A).real
    array([-0.5, -2. ])
    """
    if growth(model) <= limit:
        return model
    continuous = model.is_continuous
    bound = limit if continuous else float(np.exp(limit))

    def wild(real: float, imaginary: float) -> bool:
        return (real if continuous else abs(complex(real, imaginary))) > bound

    units = balance(model.A)  # units of the user may differ by orders of magnitude
    A = model.A * units / units[:, None]
    try:
        # ordered Schur form: the fast-growing modes first
        triangle, basis, count = linalg.schur(A, output="real", sort=wild)
    except linalg.LinAlgError:  # rounding moves modes across the bound: slow all of them down
        triangle, basis, count = A.copy(), np.eye(len(A)), len(A)
    # shift the poles in continuous time, scale them in discrete time
    block = triangle[:count, :count]
    if continuous:
        block -= (growth(model) - limit) * np.eye(count)
    else:
        block *= bound / np.exp(growth(model))
    return model.with_arrays(A=(basis @ triangle @ basis.T) * units[:, None] / units)


def observable_form(model: LinearModel) -> tuple[LinearModel, Array]:
    """Transform a SISO model to the observable canonical form.

    The form is that of equations (10) and (11) of the paper. The first column of A holds the negative
    coefficients of the characteristic polynomial, ones stand above the diagonal, and ``C = [1, 0, ..., 0]``:
    whatever is uncertain about the transfer function is then in A and B alone. Holds in continuous and in
    discrete time; the direct feedthrough D stays as it is.

    Parameters
    ----------
    model : LinearModel
        Observable model with one input and one output.

    Returns
    -------
    canonical : LinearModel
        The same transfer function, timebase, name and signal labels. The
        states are new, and labeled ``o[0]``, ``o[1]``, ...
    T : ndarray
        Transformation, shape (n, n): the new state is ``T x``.

    Raises
    ------
    control.ControlDimension
        If the model has several inputs or outputs.
    ModelError
        If the output does not see every state.

    Examples
    --------
    >>> import control as ct
    >>> from rcorefine.systems.linear import LinearModel
    >>> model = LinearModel.from_statespace(ct.ss([[0, 1], [-2, -3]], [[0], [1]], [[1, 0]], 0))
    >>> canonical, T = observable_form(model)
    >>> print(canonical.A)
    [[-3.  1.]
     [-2.  0.]]
    """
    if model.n_inputs != 1 or model.n_outputs != 1:
        raise ct.ControlDimension(
            f"the observable canonical form is for one input and one output; model {model.name!r} has "
            f"{model.n_inputs} and {model.n_outputs}. Choose one channel, or keep the form given"
        )
    n = model.n_states
    _check_observable(model)
    coefficients = characteristic_polynomial(model.A)
    canonical = np.eye(n, k=1)
    transformation = np.zeros((n, n))
    if n:
        canonical[:, 0] = -coefficients[1:]
        transformation[0] = model.C[0]
    # Row i + 1 of T A = A_o T, solved for the next row of T.
    for i in range(n - 1):
        transformation[i + 1] = transformation[i] @ model.A + coefficients[i + 1] * model.C[0]
    output = np.zeros((1, n))
    output[:, :1] = 1.0
    return (
        model.with_arrays(
            A=canonical,
            B=transformation @ model.B,
            C=output,
            D=model.D.copy(),
            state_labels=tuple(f"o[{i}]" for i in range(n)),
        ),
        transformation,
    )


def characteristic_polynomial(A: Array) -> Array:
    """Give the coefficients of ``det(s I - A)``, highest power first.

    Taken from the Hessenberg form (La Budde's recursion) rather than from
    the eigenvalues, which lose the slow poles of a stiff model.

    Parameters
    ----------
    A : ndarray
        State matrix, shape (n, n).

    Returns
    -------
    ndarray
        Coefficients, shape (n + 1,), the first one 1.

    Examples
    --------
    >>> import numpy as np
    >>> print(characteristic_polynomial(np.array([[0.0, 1.0], [-2.0, -3.0]])))
    [1. 3. 2.]
    """
    n = A.shape[0]
    if n == 0:
        return np.ones(1)
    # characteristic polynomials of the leading submatrices of the Hessenberg form
    h = linalg.hessenberg(balanced(A)[0])
    polynomials = [np.ones(1)]
    for i in range(n):
        following = np.append(polynomials[i], 0.0)
        following[1:] -= h[i, i] * polynomials[i]
        product = 1.0
        for m in range(1, i + 1):
            product *= h[i - m + 1, i - m]
            following[m + 1 :] -= h[i - m, i] * product * polynomials[i - m]
        polynomials.append(following)
    return np.asarray(polynomials[n], dtype=float)


def _check_observable(model: LinearModel) -> None:
    """Raise an error if the model is not observable (Hautus test)."""
    n = model.n_states
    if n == 0:
        return
    a, scale = balanced(model.A)
    c = model.C * scale
    a_size = float(linalg.norm(a, 2)) or 1.0
    c_size = float(linalg.norm(c, 2)) or 1.0
    # Hautus test: [A - lambda I; C] has full rank at every pole
    for pole in linalg.eigvals(a):
        pencil: NDArray[np.complex128] = np.vstack([(a - pole * np.eye(n)) / a_size, c / c_size])
        if linalg.svdvals(pencil)[-1] <= 10 * n * _EPS:
            raise ModelError(
                f"model {model.name!r} is not observable: its output does not see the mode at "
                f"{pole:.4g}, so it has no observable canonical form. Remove that mode, "
                "or keep the form given"
            )
