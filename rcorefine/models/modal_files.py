"""Modal model from the modes of a universal file (data sets of type 55)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import control as ct
import numpy as np
from scipy.linalg import block_diag

from ..arguments import as_choice, as_path, as_text, as_texts, as_vector
from ..data.formats import read_uff_modes
from ..exceptions import ConversionWarning, DataError, ModelError, warn
from ..systems.linear import Array
from ..writing import damaged

_SENSORS = ("displacement", "velocity", "acceleration")
_NORMAL, _COMPLEX = 2, (3, 7)  # codes of the analysis in data sets of type 55
_DEGREE = re.compile(r"(\d+):([+-]?[1-6])")


class _Mode(NamedTuple):
    """One mode of a universal file.

    Its output is y = 2 Re(shape q), or shape q where all is real, with (i omega - pole) q = drive w /
    scale.
    """

    pole: complex
    scale: complex
    shape: dict[str, complex]
    normal: bool


def modal_model(
    path: str | PathLike[str],
    inputs: str | Sequence[str],
    outputs: str | Sequence[str] | None = None,
    *,
    sensors: str = "displacement",
    modal_mass: float | Sequence[float] | None = None,
    name: str | None = None,
) -> ct.StateSpace:
    r"""Read the modes of a universal file (data sets of type 55) as a model.

    Parameters
    ----------
    path : str or path
        Universal file; needs pyuff.
    inputs, outputs : str or sequence of str
        Where forces act and sensors sit, as "node:direction" of the file (directions 1 to 6, a minus turns
        them: "7:-3"), which become the labels: those of `FrequencyResponse.from_uff`. Default of
        the outputs: all degrees of freedom at which a mode moves.
    sensors : {"displacement", "velocity", "acceleration"}
        What the outputs read.
    modal_mass : float or sequence of float, optional
        Modal masses to the shapes as they stand in the file, in its order, in place of those that it holds.
    name : str, optional
        Default: the name of the file.

    Returns
    -------
    StateSpace
        Two states per mode, in the order of the frequencies: ``mode1``, ``mode1_rate``, each mode a place
        with a frequency and a damping (`ports`).

    Raises
    ------
    DataError
        No modes (the types of all sets are listed), one without frequency or shape.
    ModelError
        A degree of freedom that the shapes lack, or no modal mass: shapes alone do not say how large a
        response is.
    MissingExtraError
        If the extra "formats" is not installed.

    Warns
    -----
    ConversionWarning
        Where every modal mass is exactly 1 (shapes of unit modal mass, or a number that was never
        filled in), and where a loss factor became a damping ratio.

    Notes
    -----
    A normal mode of frequency w, damping ratio z, modal mass m and shape p is
    q'' + 2 z w q' + w^2 q = p_in f / m, y = p_out q; a loss factor is taken as 2 z, which it is at the
    resonance. A complex mode of pole s, modal a and shape p is q' = s q + p_in f / a, y = 2 Re(p_out q).
    What modes outside the file add is missing: at low frequencies a spring, at high ones a mass.

    Examples
    --------
    >>> import importlib.util, pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "plate.uff"
    >>> _ = path.write_text("\n".join([
    ...     "    -1", "    55", *["NONE"] * 5,
    ...     "".join(f"{k:10d}" for k in (1, 2, 2, 8, 2, 3)), "".join(f"{k:10d}" for k in (2, 4, 1, 1)),
    ...     "".join(f"{x:13.5e}" for x in (12.5, 2.0, 0.01, 0.0)),
    ...     f"{7:10d}", "".join(f"{x:13.5e}" for x in (0.0, 0.0, 1.0)), "    -1", "",
    ... ]))
    >>> if importlib.util.find_spec("pyuff"):
    ...     plate = modal_model(path, "7:3")
    ...     assert (plate.nstates, plate.output_labels) == (2, ["7:3"])
    ...     assert np.allclose(abs(plate.poles()), 2 * np.pi * 12.5)
    """
    path = as_path(path)
    # degrees of freedom of inputs and outputs
    wanted = [as_texts(inputs, "inputs"), () if outputs is None else as_texts(outputs, "outputs")]
    for what, names in zip(("inputs", "outputs"), wanted, strict=True):
        if len(set(names)) < len(names):
            raise ct.ControlArgument(f"{what} must be different degrees of freedom, not {', '.join(names)}")
    as_choice(sensors, "sensors", _SENSORS)
    if name is not None:
        as_text(name, "name", empty=False)
    # modal masses of the user, in the order of the file
    masses = None if modal_mass is None else as_vector(modal_mass, "modal_mass", above=0.0, error=ModelError)
    sets = read_uff_modes(path)
    if masses is not None:
        if masses.size not in (1, len(sets)):
            raise ct.ControlDimension(
                f"modal_mass holds {masses.size} numbers for the {len(sets)} modes of {path}"
            )
        masses = np.broadcast_to(masses, len(sets))
    # pole, scale and shape of each mode, then by frequency
    with damaged(path):
        modes = [_mode(path, k, one, masses) for k, one in enumerate(sets)]
    modes.sort(key=lambda mode: abs(mode.pole))
    # outputs: all degrees of freedom that move
    if outputs is None:
        wanted[1] = tuple(k for k in modes[0].shape if any(mode.shape.get(k) for mode in modes))
    for label in (*wanted[0], *wanted[1]):
        _check_degree(path, label, modes)
    if masses is None and all(mode.normal and mode.scale == 1.0 for mode in modes):
        warn(
            f"{path}: every modal mass is 1: shapes of unit modal mass, or never filled in; "
            "give modal_mass= if responses are not to scale",
            ConversionWarning,
        )
    with damaged(path):
        blocks = [_block(mode, *wanted) for mode in modes]
    # modes are decoupled: block diagonal A
    A = block_diag(*(block[0] for block in blocks))
    B = np.vstack([block[1] for block in blocks])
    C = np.hstack([block[2] for block in blocks])
    D = np.zeros((len(C), B.shape[1]))
    # velocity: y' = C A x + C B w; acceleration: once more
    for _ in range(_SENSORS.index(sensors)):
        C, D = C @ A, C @ B
    states = [f"mode{k + 1}{rate}" for k in range(len(modes)) for rate in ("", "_rate")]
    signals = {"inputs": list(wanted[0]), "outputs": list(wanted[1]), "states": states}
    return ct.ss(A, B, C, D, name=name or Path(path).stem, **signals)


def _mode(path: Any, k: int, one: dict[str, Any], masses: Array | None) -> _Mode:
    """Pole, scale and shape of a data set."""
    here = f"{path}, mode {one.get('mode_n', k + 1)}"
    # shape: one complex value for each degree of freedom
    shape = {
        f"{node}:{way}": complex(value)
        for way in range(1, 7)
        if one.get(f"r{way}") is not None
        for node, value in zip(one["node_nums"], one[f"r{way}"], strict=True)
    }
    if not any(shape.values()):
        raise DataError(f"{here} has no shape: it moves nowhere")
    kind = int(one["analysis_type"])
    if kind in _COMPLEX:
        # complex mode: the pole in the upper half-plane, with its shape
        pole, scale, what = complex(one["eig"]), complex(one["modal_a"]), "modal a"
        if pole.imag < 0:
            pole, scale = pole.conjugate(), scale.conjugate()
            shape = {degree: value.conjugate() for degree, value in shape.items()}
    else:
        # normal mode: frequency and damping ratio
        w, ratio, loss = (float(one[key]) for key in ("freq", "modal_damp_vis", "modal_damp_his"))
        if not ratio and loss:
            warn(
                f"{here}: its loss factor {loss:g} is taken as a damping ratio of {loss / 2:g}, which holds "
                "at the resonance",
                ConversionWarning,
            )
        w, ratio = 2.0 * np.pi * w, ratio or loss / 2.0
        if any(abs(value.imag) > 1e-6 * abs(value) for value in shape.values()):
            raise DataError(f"{here} is a normal mode, but its shape is complex; export it as a complex mode")
        # s = -z w + i w sqrt(1 - z^2)
        pole = complex(-ratio * w, w * np.sqrt(max(1.0 - ratio**2, 0.0)))
        scale, what = complex(one["modal_m"]), "modal mass"
    if not np.isfinite([pole, scale]).all() or (kind in _COMPLEX and not pole) or pole.real > 0:
        raise DataError(f"{here}: pole {pole:.4g} rad/s with {what} {scale:.4g} is no damped mode")
    if masses is not None:  # modal a of a complex mode: 2 i w m
        scale = complex(masses[k]) * (2j * pole.imag if kind in _COMPLEX else 1.0)
    if not scale:
        raise ModelError(
            f"{here} has no {what} in the file, and shapes alone do not say how large a response is; give "
            "modal_mass= (1 for shapes that are scaled to unit modal mass)"
        )
    return _Mode(pole, scale, shape, kind == _NORMAL)


def _check_degree(path: Any, label: str, modes: Sequence[_Mode]) -> None:
    found = _DEGREE.fullmatch(label)
    if found is None:
        raise ModelError(f'{label!r} is no degree of freedom: write "node:direction", as in "7:3" or "7:-3"')
    if any(f"{found[1]}:{found[2].lstrip('+-')}" not in mode.shape for mode in modes):
        nodes = ", ".join(dict.fromkeys(degree.split(":")[0] for degree in modes[0].shape))
        raise ModelError(f"{path}: {label!r} is not in every shape; the nodes of the first mode are {nodes}")


def _block(mode: _Mode, inputs: Sequence[str], outputs: Sequence[str]) -> tuple[Array, Array, Array]:
    """Return the matrices A, B, C of one mode.

    Its states are displacement and rate (normal mode), or real and imaginary part (complex mode).
    """
    # shape at inputs and outputs, with the sign of the direction
    drive, sense = (
        np.array(
            [
                mode.shape[label.replace("-", "").replace("+", "")] * (-1.0 if ":-" in label else 1.0)
                for label in labels
            ]
        )
        for labels in (inputs, outputs)
    )
    drive = drive / mode.scale
    s = mode.pole
    # normal mode: q'' + 2 z w q' + w^2 q = drive w
    if mode.normal:
        A, B = np.array([[0.0, 1.0], [-(abs(s) ** 2), 2.0 * s.real]]), drive.real
        return A, np.vstack([0.0 * B, B]), np.column_stack([sense.real, 0.0 * sense.real])
    # complex mode: real and imaginary part of q' = s q + drive w
    A = np.array([[s.real, -s.imag], [s.imag, s.real]])
    return A, np.vstack([drive.real, drive.imag]), 2.0 * np.column_stack([sense.real, -sense.imag])
