"""Readers of HDF5, MATLAB 7.3, TDMS and universal files.

They use other packages, which are imported when first needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..arguments import as_number
from ..exceptions import DataError, MissingExtraError
from ..extras import needed
from ..systems.linear import Array
from .apart import damaged, read_apart
from .columns import Columns, vectors
from .columns import read_mat as read_old_mat

__all__ = ["read_hdf5", "read_mat", "read_tdms", "read_uff", "read_uff_modes", "read_uff_responses"]


def read_hdf5(path: Any, names: Sequence[str], reader: str = "from_hdf5") -> Columns:
    """Named data sets of an HDF5 file: "group/name", or "group.name"."""
    needed("h5py", "formats", reader)
    return vectors(path, read_apart(path, "hdf5", "HDF5 file that h5py", names), names)


def read_mat(path: Any, names: Sequence[str]) -> Columns:
    """Read named variables of a MATLAB file.

    Version 7.3 of the format needs h5py.
    """
    with open(path, "rb") as file:
        new = file.read(10) == b"MATLAB 7.3"
    if not new:
        return read_old_mat(path, names)
    try:
        return read_hdf5(path, names, "from_mat")
    except MissingExtraError:
        return read_old_mat(path, names)  # which says what to do
    except DataError as error:
        raise DataError(
            f"{error}. As a MATLAB 7.3 file it may be saved anew with save(..., '-v7')"
        ) from error


def read_tdms(path: Any, names: Sequence[str]) -> Columns:
    """Read named channels of a TDMS file.

    A name is "group/channel", or the channel alone where only one group has it.
    """
    nptdms = needed("nptdms", "formats", "from_tdms")
    with open(path, "rb"):
        pass
    with damaged(path, "is not a TDMS file that npTDMS can read, or it is damaged"):
        file = nptdms.TdmsFile.read(path)
        channels = [channel for group in file.groups() for channel in group.channels()]
        listed = ", ".join(f"'{c.group_name}/{c.name}' {len(c)}" for c in channels) or "none"
        values, units = {}, {}
        for name in names:
            found = [c for c in channels if name in (c.name, f"{c.group_name}/{c.name}")]
            if len(found) != 1:
                how = "no channel" if not found else f"{len(found)} channels"
                raise DataError(f"{path} has {how} {name!r}; there are: {listed}")
            values[name] = np.asarray(found[0][:])
            units[name] = str(found[0].properties.get("unit_string", ""))
        steps = {float(c.properties["wf_increment"]) for c in channels if c.properties.get("wf_increment")}
    said = f"{path}: the file says wf_increment = {', '.join(f'{s:g}' for s in sorted(steps))} s"
    return Columns(values, {k: v for k, v in units.items() if v}, (said,) if steps else ())


def read_uff(path: Any, sets: Sequence[int]) -> tuple[list[Array], list[str], list[str], float]:
    """Read time histories of a universal file.

    They are data sets of type 58. Values, names, units and the sampling time are returned.
    """
    kinds, read = _sets_of(path, sets)
    values, names, units, steps = [], [], [], set()
    for k, found in zip(sets, read, strict=True):
        if found is None or found.get("func_type") not in (0, 1):
            what = "there is none" if k >= len(kinds) else "no time history of type 58"
            raise DataError(f"{path}: data set {k} is not a record ({what}); its sets are of types {kinds}")
        values.append(np.asarray(found["data"], dtype=float).ravel())
        names.append(f"{found.get('rsp_node', k)}:{found.get('rsp_dir', 0)}")
        units.append(str(found.get("ordinate_axis_units_lab", "")).strip().replace("NONE", ""))
        steps.add(float(found["abscissa_inc"]))
    if len(steps) > 1:
        raise DataError(f"{path}: the data sets have different sampling times: {sorted(steps)} s")
    dt = as_number(steps.pop(), "the sampling time of the file", above=0.0, error=DataError)
    return values, names, units, dt


def _sets_of(
    path: Any, sets: Sequence[int] | None, kind: int = 58
) -> tuple[list[int], list[dict[str, Any] | None]]:
    """Read the data sets of one type from a universal file.

    The types of all data sets are returned, and the requested sets (all for None). A set of another type is
    None.
    """
    pyuff = needed("pyuff", "formats", "from_uff")
    with open(path, "rb"):
        pass
    with damaged(path, "is not a universal file that pyuff can read, or it is damaged"):
        file = pyuff.UFF(str(path))
        kinds = [int(one) for one in file.get_set_types()]
        asked = range(len(kinds)) if sets is None else sets
        read = [file.read_sets(k) if k < len(kinds) and kinds[k] == kind else None for k in asked]
    for k, one in zip(asked, read, strict=True):  # pyuff takes what there is
        if kind == 58 and one is not None and np.size(one["data"]) < (n := one["num_pts"]):
            raise DataError(f"{path}: data set {k} announces {n} values and holds fewer; it is damaged")
    return kinds, read


_RESPONSE, _COHERENCE = 4, 6  # what an ordinate of type 58 is


def read_uff_responses(path: Any, sets: Sequence[int] | None) -> dict[str, Any]:
    """Read frequency responses of a universal file.

    They are data sets of type 58, and are returned as arguments of `FrequencyResponse`.
    """
    responses, known = _sorted(path, sets)
    outputs, inputs = (list(dict.fromkeys(place[side] for place in responses)) for side in (0, 1))
    if len(responses) != len(outputs) * len(inputs):
        raise DataError(
            f"{path} holds {len(responses)} responses of {len(outputs)} outputs to {len(inputs)} inputs, not "
            "each to each; name those of a full matrix in sets="
        )
    first = np.asarray(next(iter(responses.values()))["x"], dtype=float).ravel()
    for place, one in responses.items():
        x = np.asarray(one["x"], dtype=float).ravel()
        if x.shape != first.shape or not np.allclose(x, first, rtol=1e-6):
            raise DataError(f"{path}: response {place[0]} to {place[1]} has other frequencies than the first")
    table = np.array([[np.asarray(responses[y, w]["data"]).ravel() for w in inputs] for y in outputs])
    kept = first > 0
    made: dict[str, Any] = {"response": table[:, :, kept], "omega": 2.0 * np.pi * first[kept]}
    made |= {"input_labels": inputs, "output_labels": outputs}
    if len(inputs) == 1 and all((y, inputs[0]) in known for y in outputs):
        rows = np.array([np.asarray(known[y, inputs[0]]["data"]).real.ravel() for y in outputs])
        if rows.shape[1] == first.size:
            made["coherence"] = np.clip(rows[:, kept], 0.0, 1.0)
    return made


_Found = dict[tuple[str, str], dict[str, Any]]


def _sorted(path: Any, sets: Sequence[int] | None) -> tuple[_Found, _Found]:
    """Frequency responses and coherences, by response and reference."""
    kinds, read = _sets_of(path, sets)
    found: dict[int, _Found] = {_RESPONSE: {}, _COHERENCE: {}}
    for k, one in zip(range(len(kinds)) if sets is None else sets, read, strict=True):
        what = -1 if one is None else int(one.get("func_type", -1))
        if one is None or what not in found:
            if sets is not None:
                raise DataError(
                    f"{path}: data set {k} is no frequency response; its sets are of types {kinds}"
                )
            continue
        names = (f"{one.get(f'{side}_node', 0)}:{one.get(f'{side}_dir', 0)}" for side in ("rsp", "ref"))
        place = next(names), next(names)
        if place in found[what]:
            raise DataError(f"{path} holds response {place[0]} to {place[1]} twice; name one in sets=")
        found[what][place] = one
    if not found[_RESPONSE]:
        hint = " Sets of type 55 are modes, a model and not a measurement: rcorefine.modal_model reads them"
        said = f"{path} holds no frequency response; its sets are of types {kinds}."
        raise DataError(said + hint * (_MODE in kinds))
    return found[_RESPONSE], found[_COHERENCE]


_MODE, _ANALYSES = 55, (2, 3, 7)  # normal modes, complex ones of first and of second order


def read_uff_modes(path: Any) -> list[dict[str, Any]]:
    """Modes (data sets of type 55) of a universal file."""
    kinds, read = _sets_of(path, None, _MODE)
    modes = [one for one in read if one is not None and one.get("analysis_type") in _ANALYSES]
    if not modes:
        raise DataError(f"{path} holds no modes (type 55 of a modal analysis); its sets are of types {kinds}")
    return modes
