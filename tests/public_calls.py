"""One small valid call of every public function and method, and what each argument is.

The kinds are those of `KINDS`: a predicate that tells which values may pass. An argument
that is not named here takes anything (`ANY`).
"""

from __future__ import annotations

import functools
import inspect
import math
import numbers
import pathlib
import tempfile
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import control as ct
import numpy as np

import rcorefine as rco

N, DT = 260, 0.05


# ------------------------------------------------------------------ what the calls need
def small_model() -> rco.PhysicalModel:
    return rco.mass_spring_damper(1.0, 0.8, 25.0)


def small_record(seed: int = 0, stiffness: float = 25.0, n: int = N) -> rco.Measurement:
    rng = np.random.default_rng(seed)
    force = rng.standard_normal(n)
    blank = rco.Measurement(force, np.zeros(n), dt=DT)
    y = rco.simulate(rco.mass_spring_damper(1.0, 0.8, stiffness), blank, "zero").outputs[0]
    return rco.Measurement(force, y + 0.02 * y.std() * rng.standard_normal(n), dt=DT)


EFFECT = rco.Effect("stiffness", "link1")


def _quiet(make: Callable[[], Any]) -> Callable[[], Any]:
    @functools.cache
    def made() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return make()

    return made


record = _quiet(small_record)
model = _quiet(small_model)
refinement = _quiet(lambda: rco.refine(small_model(), record(), [EFFECT]))
comparison = _quiet(lambda: rco.compare(small_model(), record()))
checked = _quiet(lambda: rco.check(small_model(), record(), information=False))
in_frequency = _quiet(lambda: rco.compare(small_model(), response()))
response = _quiet(lambda: record().frequency_response(segment_length=60))
diagnosis = _quiet(
    lambda: rco.diagnose(
        small_model(), small_record(1, 20.0), candidates=[EFFECT, rco.Effect("damping", "link1")]
    )
)
HARD = rco.Effect("cubic_stiffness", "link1", fixed={"cubic_stiffness": 800.0})


@_quiet
def nameless() -> rco.Diagnosis:
    loud = small_record(1, n=1200)
    harder = rco.simulate(rco.refine(small_model(), loud, [HARD]), loud, "zero").outputs[0]
    y = harder + 0.02 * harder.std() * np.random.default_rng(2).standard_normal(1200)
    data = rco.Measurement(loud.inputs, y, dt=DT)
    return rco.diagnose(small_model(), data, candidates=[rco.Effect("damping", "link1")])


advice = _quiet(lambda: diagnosis().suggest_experiment(lengths=[2.0], amplitudes=[2.0], bands=[]))
improvement = _quiet(
    lambda: rco.improve(small_model(), small_record(1, 20.0, 600), candidates=[EFFECT], max_effects=1)
)
confirmation = _quiet(lambda: rco.confirm(refinement(), [record(), small_record(2)], candidates=[EFFECT]))
surveyed = _quiet(
    lambda: rco.survey(
        small_model(), {"a": record(), "b": small_record(2)}, "refine", options={"effects": [EFFECT]}
    )
)
damage_map = _quiet(lambda: rco.localize_damage(small_model(), small_record(3, 20.0)))
curve = _quiet(lambda: rco.frequency_response_at(small_model(), [3.0, 5.0], 1.0, harmonics=3))
example = _quiet(rco.examples.rlc)
exercise = _quiet(lambda: rco.exercises.hidden_effect(3))
ANSWER = {"kind": "input_gain", "place": "voltage", "coefficient": 0.1}
folder = functools.cache(lambda: pathlib.Path(tempfile.mkdtemp(prefix="rcorefine-")))


@functools.cache
def handed_in() -> pathlib.Path:
    """A folder of one exercise and one answer."""
    at = pathlib.Path(tempfile.mkdtemp(dir=folder()))
    exercise().save(at / "ada.npz")
    exercise().hand_in(at / "ada.json", "Ada", **ANSWER)
    return at


def monitor() -> rco.Monitor:
    return rco.Monitor(small_model(), [EFFECT], dt=DT, learn=200)


@_quiet
def watched() -> rco.Monitor:
    found = rco.Monitor(small_model(), [EFFECT], dt=DT, learn=200)
    return found.run(record())


@_quiet
def alarmed() -> rco.Alarm:
    found = rco.Monitor(small_model(), [EFFECT], dt=DT, learn=200).run(record())
    found.run(small_record(4, 15.0))
    assert found.alarm is not None
    return found.alarm


def refiner() -> rco.RCORefiner:
    return rco.RCORefiner.paper(small_model().system, dt=DT, order=2, window=20, learning_rate=1e6)


@_quiet
def taught() -> rco.RCORefiner:
    return refiner().run(record())


@functools.cache
def files() -> dict[str, pathlib.Path]:
    """A record in every format, and saved objects."""
    import scipy.io

    at = folder()
    u, y = record().inputs[0], record().outputs[0]
    np.savetxt(at / "a.csv", np.column_stack([u, y]), delimiter=",", header="u,y", comments="")
    scipy.io.savemat(at / "a.mat", {"u": u, "y": y})
    np.savez(at / "a.npz", u=u, y=y)
    (at / "frf.csv").write_text("f [Hz],H,phase [deg]\n" + "".join(f"{k + 1},1,{-k}\n" for k in range(20)))
    (at / "model.toml").write_text("[series_rlc]\nR = 250.0\nL = 0.055\nC = 23.5e-6\n")
    watched().save(at / "monitor.npz")
    taught().save(at / "refiner.npz")
    names = ("a.csv", "frf.csv", "a.mat", "a.npz", "model.toml", "monitor.npz", "refiner.npz")
    return {name: at / name for name in names}


# ------------------------------------------------------------------ what an argument may be
def is_number(value: Any) -> bool:
    if isinstance(value, np.ndarray):  # of one entry: taken or refused, as the function likes
        return value.size == 1 and value.dtype.kind in "fiu" and bool(np.isfinite(value).all())
    return (
        isinstance(value, numbers.Real)
        and not isinstance(value, bool | np.bool_)
        and math.isfinite(_float(value))
    )


def _float(value: Any) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf


def is_positive(value: Any) -> bool:
    return is_number(value) and _float(value) > 0


def is_level(value: Any) -> bool:
    return is_number(value) and _float(value) >= 0


def is_share(value: Any) -> bool:
    return is_number(value) and 0 < _float(value) < 1


def is_whole(value: Any) -> bool:
    return is_number(value) and _float(value) == round(_float(value)) and _float(value) >= 0


def is_flag(value: Any) -> bool:
    return isinstance(value, bool | np.bool_)


def is_text(value: Any) -> bool:
    return isinstance(value, str | np.str_)


def is_texts(value: Any) -> bool:
    if is_text(value):
        return True
    if isinstance(value, Iterator):
        value = list(value)
    if isinstance(value, np.ndarray):
        return value.dtype.kind == "U" or value.size == 0
    return _listed(value) and all(is_text(item) for item in value) and len(set(value)) == len(value)


def is_words(value: Any) -> bool:
    """Texts of which two may be alike, such as units."""
    return is_texts(value) or (isinstance(value, list) and value == ["x", "x"])


def _listed(value: Any) -> bool:
    return (
        not isinstance(value, str | bytes | Mapping | set)
        and hasattr(value, "__len__")
        and getattr(value, "ndim", 1) > 0
    )


def is_numbers(value: Any) -> bool:
    """An array of finite numbers of any shape."""
    if is_number(value):
        return True
    if not _listed(value) or isinstance(value, bytearray | memoryview):
        return False
    try:
        array = np.array(value)
    except (ValueError, RecursionError):
        return False
    masked = np.ma.isMaskedArray(value) and np.ma.getmaskarray(value).any()
    return not masked and array.dtype.kind in "fiub" and bool(np.isfinite(array).all())


def is_signal(value: Any) -> bool:
    """A record may hold counts and switches too."""
    return is_flag(value) or (is_numbers(value) and np.asarray(value).size > 0)


def is_state(value: Any) -> bool:
    return not is_flag(value) and is_numbers(value) and np.array(value).dtype.kind != "b"


def is_places(value: Any) -> bool:
    return isinstance(value, Iterator) or is_state(value)


def is_seed(value: Any) -> bool:
    return is_whole(value) or isinstance(value, np.random.Generator)


def is_listing(value: Any) -> bool:
    """An empty list of effects or the like; none of the usual values is an effect."""
    return _listed(value) and len(value) == 0


def is_mapping(value: Any) -> bool:
    return isinstance(value, Mapping)


def is_path(value: Any) -> bool:
    return isinstance(value, str | pathlib.PurePath)


def is_nothing(value: Any) -> bool:
    return False


def is_transfer_function(value: Any) -> bool:
    """A model where it has a realization."""
    return isinstance(value, ct.TransferFunction)


def is_window(value: Any) -> bool:
    return is_text(value) or isinstance(value, tuple)


def is_legend(value: Any) -> bool:
    return is_text(value) or value is False


def or_none(kind: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """Behind **keywords, where no default tells that None is fine."""
    return lambda value: value is None or kind(value)


ANY: Callable[[Any], bool] = lambda value: True  # noqa: E731
LABELS = dict.fromkeys(("inputs", "outputs", "states"), is_texts)
NAMES = dict.fromkeys(("name", "position_unit", "force_unit", "angle_unit"), is_text)
OPTIONS: dict[str, Callable[[Any], bool]] = {
    "ax": is_nothing,
    "label": is_words,
    "title": is_text,
    "legend_loc": is_legend,
    "rcParams": is_mapping,
    "show_legend": is_flag,
}
REPORT = {"path": is_path, "title": is_text, "code": is_text, "overwrite": is_flag}
UNITS = {
    "hold": is_text,
    "input_labels": is_texts,
    "output_labels": is_texts,
    "input_units": is_words,
    "output_units": is_words,
    "name": is_text,
}
TABLE = {"delimiter": is_text, "decimal": is_text, "header": is_texts}
OPTIONAL = {key: or_none(kind) for key, kind in UNITS.items()}
FIT = {
    "model": is_transfer_function,
    "data": is_nothing,
    "free": lambda value: is_text(value) or is_listing(value),
    "tolerance": is_level,
    "offset": is_flag,
    "noise": is_numbers,
    "significance": is_share,
    "horizon": is_positive,
    "x0": is_state,
    "executor": is_nothing,
    "progress": is_flag,
    "validation": is_nothing,
    "candidates": is_listing,
    "effects": is_listing,
    "controller": is_transfer_function,
}


@dataclass(frozen=True)
class Call:
    """A function, valid arguments, and what each argument may be.

    `heavy` marks calls whose work takes longer than the checks of their arguments: the
    quick test stops them where the work begins, at the function `work`.
    """

    function: Callable[[], Callable[..., Any]]
    valid: Callable[[], Mapping[str, Any]]
    kinds: Mapping[str, Callable[[Any], bool]] = field(default_factory=dict)
    work: str | None = None
    needs: Callable[[], object] | None = None  # arguments behind **keywords
    more: tuple[str, ...] = ()
    skip: tuple[str, ...] = ()

    def arguments(self) -> list[str]:
        found = [
            name
            for name, item in inspect.signature(self.function()).parameters.items()
            if item.kind not in (item.VAR_KEYWORD, item.VAR_POSITIONAL)
        ]
        return [name for name in (*found, *self.more) if name not in self.skip]

    def default(self, name: str) -> Any:
        item = inspect.signature(self.function()).parameters.get(name)
        return inspect.Parameter.empty if item is None else item.default


def _method(owner: Callable[[], Any], name: str) -> Callable[[], Callable[..., Any]]:
    return lambda: getattr(owner(), name)


def _plot(owner: Callable[[], Any], name: str = "plot", **kinds: Any) -> Call:
    return Call(_method(owner, name), dict, {**OPTIONS, **kinds})


def _report(owner: Callable[[], Any], **kinds: Any) -> Call:
    return Call(_method(owner, "report"), lambda: {"path": folder() / "report.html"}, {**REPORT, **kinds})


def _reader(name: str, path: str, work: str | None = None) -> Call:
    return Call(
        lambda: getattr(rco.Measurement, name),
        lambda: {"path": files()[path], "inputs": "u", "outputs": "y", "dt": DT},
        {
            **LABELS,
            "path": is_path,
            "time": is_text,
            "dt": is_positive,
            **TABLE,
            **OPTIONAL,
        },
        work=work,
        more=tuple(UNITS),
    )


def _builder(function: Callable[..., Any], kinds: Mapping[str, Any], **valid: Any) -> Call:
    return Call(lambda: function, lambda: valid, {**LABELS, **NAMES, **kinds})


def _frame() -> Any:
    import pandas as pd

    return pd.DataFrame({"u": record().inputs[0], "y": record().outputs[0]})


def _port() -> Mapping[str, Any]:
    return {
        "name": "x1",
        "kind": "mechanical",
        "act": [0.0, -2.0],
        "position": [1.0, 0.0],
        "velocity": [0.0, 1.0],
    }


def _parts() -> Mapping[str, Any]:
    built = small_model()
    return {item: getattr(built, item) for item in inspect.signature(rco.PhysicalModel).parameters}


def is_points(value: Any) -> bool:
    """A complex response."""
    return is_numbers(value) or (getattr(getattr(value, "dtype", None), "kind", "") == "c")


EXAMPLE = {"form": is_text, "dt": is_positive}
MEASURE, RESPONSE = rco.Measurement, rco.FrequencyResponse
SPECTRUM = {
    **UNITS,
    "amplitude": is_numbers,
    "n_averages": is_positive,
    "segment_length": is_whole,
    "n_omitted": is_whole,
    "dt": is_level,
}
CALLS: dict[str, Call] = {
    # the record
    "Measurement": Call(
        lambda: MEASURE,
        lambda: {"inputs": np.arange(7.0), "outputs": np.arange(7.0), "dt": DT},
        {
            **UNITS,
            "inputs": is_signal,
            "outputs": is_signal,
            "dt": is_positive,
            "timepts": is_state,
            "notes": is_words,
            "origin": lambda v: is_state(v) and np.size(v) == 2,
        },
    ),
    "Measurement.deviation": Call(
        _method(record, "deviation"), dict, {"inputs": or_none(is_numbers), "outputs": or_none(is_numbers)}
    ),
    "Measurement.check_excitation": Call(_method(record, "check_excitation"), dict, {"purpose": is_text}),
    "Measurement.detrend": Call(_method(record, "detrend"), dict),
    "Measurement.filter": Call(
        _method(record, "filter"),
        lambda: {"high": 0.9 * np.pi / DT},
        {"low": or_none(is_positive), "high": or_none(is_positive), "order": is_whole},
    ),
    "Measurement.rename": Call(
        _method(record, "rename"),
        lambda: {"name": "run 2"},
        {"labels": or_none(is_mapping), "name": or_none(is_text)},
    ),
    "Measurement.join": Call(
        _method(record, "join"),
        lambda: {
            "other": record().rename({n: n + "b" for n in (*record().input_labels, *record().output_labels)})
        },
        {"other": is_nothing},
    ),
    "Measurement.decimate": Call(_method(record, "decimate"), lambda: {"factor": 2}, {"factor": is_whole}),
    "Measurement.from_timestamps": Call(
        lambda: MEASURE.from_timestamps,
        lambda: {"timepts": np.arange(7.0), "inputs": np.arange(7.0), "outputs": np.arange(7.0), "dt": DT},
        {
            **OPTIONAL,
            "timepts": is_state,
            "output_timepts": or_none(is_state),
            "inputs": is_signal,
            "outputs": is_signal,
            "dt": is_positive,
            "longest_gap": is_positive,
        },
        more=tuple(key for key in UNITS if key != "hold"),
    ),
    "Measurement.free_decay": Call(
        lambda: MEASURE.free_decay,
        lambda: {"outputs": np.cos(np.arange(50.0)), "dt": DT},
        {
            **{key: OPTIONAL[key] for key in ("output_labels", "output_units", "name") if key in OPTIONAL},
            "outputs": is_signal,
            "dt": is_positive,
            "timepts": or_none(is_state),
            "release": or_none(is_number),
        },
        more=tuple(key for key in ("output_labels", "output_units", "name") if key in UNITS),
    ),
    "Measurement.frequency_response": Call(
        _method(record, "frequency_response"),
        lambda: {"segment_length": 60},
        {"segment_length": is_whole, "overlap": is_level, "window": is_window},
    ),
    "Measurement.plot": _plot(record),
    "Measurement.segment": Call(
        _method(record, "segment"),
        dict,
        {
            "start": lambda v: is_number(v) or _is_infinite(v),
            "stop": lambda v: is_number(v) or _is_infinite(v),
        },
    ),
    "Measurement.split": Call(_method(record, "split"), lambda: {"fraction": 0.5}, {"fraction": is_share}),
    "Measurement.to_response": Call(_method(record, "to_response"), dict),
    "PhysicalModel.held": Call(_method(model, "held"), lambda: {"data": record()}, {"data": is_nothing}),
    **{
        f"Refinement.to_{language}": Call(
            _method(refinement, f"to_{language}"), dict, {"path": or_none(is_path)}
        )
        for language in ("python", "c", "matlab")
    },
    "Refinement.linearize": Call(
        _method(refinement, "linearize"),
        lambda: {"states": np.zeros(2), "inputs": [0.0]},
        {
            "states": lambda v: is_state(v) and np.size(v) == 2,
            "inputs": lambda v: is_state(v) and np.size(v) == 1,
        },
    ),
    "Refinement.with_hold": Call(
        _method(refinement, "with_hold"), lambda: {"hold": "foh"}, {"hold": or_none(is_text)}
    ),
    "Comparison.seen_by": Call(_method(comparison, "seen_by"), lambda: {"index": 0}, {"index": is_number}),
    "Measurement.with_hold": Call(_method(record, "with_hold"), lambda: {"hold": "foh"}, {"hold": is_text}),
    "Measurement.from_csv": _reader("from_csv", "a.csv"),
    "Measurement.from_mat": _reader("from_mat", "a.mat", work="rcorefine.data.readers.read_mat"),
    "Measurement.from_npz": _reader("from_npz", "a.npz"),
    "Measurement.from_hdf5": _reader("from_hdf5", "a.npz", work="rcorefine.data.readers.read_hdf5"),
    "Measurement.from_uff": Call(
        lambda: MEASURE.from_uff,
        lambda: {"path": files()["a.npz"], "input_set": 0, "output_set": 1},
        {**OPTIONAL, "path": is_path, **dict.fromkeys(("input_set", "output_set"), is_places)},
        work="rcorefine.data.readers.read_uff",
        more=tuple(UNITS),
    ),
    "Measurement.from_benchmark": Call(
        lambda: MEASURE.from_benchmark,
        lambda: {"data": types.SimpleNamespace(u=np.ones(7), y=np.zeros(7), sampling_time=DT)},
        {**OPTIONAL, "data": is_nothing},
        more=tuple(UNITS),
    ),
    "Measurement.from_frame": Call(
        lambda: MEASURE.from_frame,
        lambda: {"frame": _frame(), "inputs": "u", "outputs": "y", "dt": DT},
        {
            **OPTIONAL,
            **LABELS,
            "frame": is_mapping,
            "time": is_text,
            "dt": is_positive,
        },
        more=tuple(UNITS),
    ),
    "Measurement.from_response": Call(
        lambda: MEASURE.from_response,
        lambda: {"response": record().to_response()},
        {**UNITS, "response": is_nothing, "dt": is_positive},
    ),
    "FrequencyResponse": Call(
        lambda: RESPONSE,
        lambda: {"response": np.arange(1.0, 8.0), "omega": np.arange(1.0, 8.0)},
        {**SPECTRUM, "response": is_points, "omega": is_numbers, "std": is_numbers, "coherence": is_numbers},
    ),
    "FrequencyResponse.from_frd": Call(
        lambda: RESPONSE.from_frd,
        lambda: {"response": ct.frd(np.arange(1.0, 8.0), np.arange(1.0, 8.0), name="analyzer")},
        {
            **{key: or_none(kind) for key, kind in SPECTRUM.items()},
            "response": is_nothing,
            "std": or_none(is_numbers),
            "coherence": or_none(is_numbers),
        },
        more=("std", "coherence", "amplitude", "n_averages", "input_units", "output_units", "name"),
    ),
    "FrequencyResponse.from_csv": Call(
        lambda: RESPONSE.from_csv,
        lambda: {"path": files()["frf.csv"], "frequency": "f", "magnitude": "H", "phase": "phase"},
        {
            **{key: or_none(kind) for key, kind in SPECTRUM.items()},
            **dict.fromkeys(("magnitude", "phase", "real", "imag", "coherence", "std"), is_texts),
            **dict.fromkeys(("frequency", "frequency_unit", "magnitude_unit", "phase_unit"), is_text),
            **TABLE,
            "path": is_path,
        },
        more=("amplitude", "n_averages", "input_labels", "output_labels", "dt", "hold", "name"),
    ),
    "FrequencyResponse.from_uff": Call(
        lambda: RESPONSE.from_uff,
        lambda: {"path": files()["a.npz"]},
        {**{key: or_none(kind) for key, kind in SPECTRUM.items()}, "path": is_path, "sets": is_places},
        work="rcorefine.data.frequency_response.read_uff_responses",
        more=("amplitude", "n_averages", "input_labels", "output_labels", "dt", "hold", "name"),
    ),
    **{f"FrequencyResponse.{name}": Call(_method(response, name), dict) for name in ("isctime", "isdtime")},
    "FrequencyResponse.plot": _plot(response),
    # models and their places
    "mass_spring_damper": _builder(
        rco.mass_spring_damper,
        {"m": is_numbers, "c": is_numbers, "k": is_numbers, "excitation": is_text},
        m=[1.0, 1.0],
        c=[0.1, 0.1],
        k=[10.0, 10.0],
    ),
    "mechanical": _builder(
        rco.mechanical,
        {
            "M": is_numbers,
            "C": is_numbers,
            "K": is_numbers,
            "damping_ratio": is_numbers,
            "excitation": is_text,
            "links": is_mapping,
            "n_modes": or_none(is_number),
        },
        M=[2.0, 1.0],
        K=[[3.0, -1.0], [-1.0, 1.0]],
    ),
    "read_model": Call(
        lambda: rco.read_model,
        lambda: {"path": files()["model.toml"]},
        {"path": is_path},
        work="rcorefine.models.reading._from_toml",
    ),
    "read_record": Call(
        lambda: rco.read_record,
        lambda: {"path": files()["a.csv"], "inputs": "u", "outputs": "y", "dt": DT},
        {
            "path": is_path,
            "model": is_transfer_function,
            **dict.fromkeys(("inputs", "outputs"), is_texts),
            **dict.fromkeys(("time", "hold", "decimal"), is_text),
            "dt": is_positive,
        },
        work="rcorefine.data.tables._find_layout",
    ),
    "modal_model": Call(
        lambda: rco.modal_model,
        lambda: {"path": files()["a.npz"], "inputs": "1:3"},
        {
            "path": is_path,
            **dict.fromkeys(("inputs", "outputs"), is_texts),
            **dict.fromkeys(("sensors", "name"), is_text),
            "modal_mass": is_numbers,
        },
        work="rcorefine.models.modal_files.read_uff_modes",
    ),
    "series_rlc": _builder(
        rco.series_rlc,
        {"R": is_level, "L": is_positive, "C": is_positive, "sensors": is_texts},
        R=1.0,
        L=0.1,
        C=0.1,
    ),
    "dc_motor": _builder(
        rco.dc_motor,
        {
            **dict.fromkeys(("time_constant", "R", "L", "Kt", "Ke", "J", "b"), is_level),
            "gain": is_number,
            "load_torque": is_flag,
            "sensors": is_texts,
        },
        R=1.0,
        L=1e-3,
        Kt=0.1,
        J=1e-3,
    ),
    "dc_motor (speed)": _builder(
        rco.dc_motor,
        {"time_constant": is_positive, "gain": is_number, "sensors": is_texts},
        gain=2.0,
        time_constant=0.5,
    ),
    "quarter_car": _builder(
        rco.quarter_car,
        {
            **dict.fromkeys(
                ("body_mass", "wheel_mass", "suspension_stiffness", "tire_stiffness"), is_positive
            ),
            "suspension_damping": is_level,
            "tire_damping": is_level,
            "road": is_text,
            "actuator": is_flag,
            "sensors": is_texts,
        },
        body_mass=250.0,
        wheel_mass=35.0,
        suspension_stiffness=16e3,
        suspension_damping=1e3,
        tire_stiffness=160e3,
    ),
    "thermal_network": _builder(
        rco.thermal_network,
        {
            "capacities": is_numbers,
            "resistances": is_mapping,
            "ambient_input": is_flag,
            "heat": is_numbers,
            "sensors": is_numbers,
        },
        capacities=[10.0, 20.0],
        resistances={(1, 2): 0.5, (2, 0): 2.0},
    ),
    "two_tanks": _builder(
        rco.two_tanks,
        {
            "areas": is_numbers,
            "outflows": is_numbers,
            "pump_gain": is_positive,
            "sensors": is_numbers,
            **dict.fromkeys(("level_unit", "flow_unit", "pump_unit"), is_text),
        },
    ),
    "Port": Call(
        lambda: rco.Port,
        _port,
        {
            "name": is_text,
            "kind": is_text,
            **dict.fromkeys(("position_unit", "velocity_unit", "force_unit", "description"), is_text),
            **dict.fromkeys(
                ("act", "position", "velocity", "position_input", "velocity_input", "acceleration_input"),
                is_numbers,
            ),
        },
    ),
    "PhysicalModel": Call(
        lambda: rco.PhysicalModel,
        _parts,
        {
            "linear": is_nothing,
            **dict.fromkeys(("output_state", "output_rate", "output_input"), is_numbers),
            "ports": is_listing,
            "parameters": is_listing,
            **dict.fromkeys(
                ("input_units", "output_units", "state_units"),
                lambda v: is_texts(v) or isinstance(v, list | tuple | np.ndarray),
            ),
        },
    ),
    "PhysicalModel.from_statespace": Call(
        lambda: rco.PhysicalModel.from_statespace,
        lambda: {"sys": ct.ss([[0.5]], [[1.0]], [[1.0]], 0, True), "dt": DT},
        {"sys": is_transfer_function, "dt": is_positive},
    ),
    "physical": Call(
        lambda: rco.physical,
        lambda: {
            "system": ct.ss([[0.5]], [[1.0]], [[1.0]], 0, True, states=["T"]),
            "links": {"leak": {"T": 1.0}},
            "units": {"T": "K"},
            "parameters": {"G": ("damping", "T", 0.5)},
            "operating_point": {"inputs": 1.0, "states": 2.0},
            "dt": DT,
        },
        {
            "system": is_nothing,
            "links": lambda v: v is None or v == {},
            "units": lambda v: v is None or v == {},
            "parameters": lambda v: v is None or v == {},
            "operating_point": lambda v: v is None,
            "dt": is_positive,
        },
    ),
    "PhysicalModel.port": Call(_method(model, "port"), lambda: {"name": "link1"}, {"name": is_text}),
    "PhysicalModel.entry": Call(_method(model, "entry"), lambda: {"place": "A[0,1]"}, {"place": is_text}),
    "PhysicalModel.check": Call(_method(model, "check"), lambda: {"effect": EFFECT}, {"effect": is_nothing}),
    "PhysicalModel.unit": Call(
        _method(model, "unit"),
        lambda: {"effect": EFFECT, "coefficient": "stiffness"},
        {"effect": is_nothing, "coefficient": is_text},
    ),
    "NominalParameter": Call(
        lambda: rco.NominalParameter,
        lambda: {"name": "k", "value": 1.0, "unit": "N/m", "kind": "stiffness", "place": "link1"},
        {
            "name": is_text,
            "value": is_number,
            "unit": is_text,
            "kind": is_text,
            "place": is_text,
            "physical": is_flag,
        },
    ),
    "ports": Call(
        lambda: rco.ports, lambda: {"model": model()}, {"model": is_transfer_function, "dt": is_positive}
    ),
    "d2c": Call(
        lambda: rco.d2c,
        lambda: {"system": ct.ss([[0.5]], [[1.0]], [[1.0]], 0, 0.1)},
        {"system": is_nothing, "method": is_text},
    ),
    # effects
    "Effect": Call(
        lambda: rco.Effect,
        lambda: {"kind": "cubic_stiffness", "place": "link1"},
        {
            "kind": is_text,
            "place": is_text,
            "name": is_text,
            "start": is_mapping,
            "fixed": is_mapping,
            "prior": is_mapping,
            "law": is_nothing,
        },
    ),
    "Effect (custom)": Call(
        lambda: rco.Effect,
        lambda: {"kind": "custom", "place": "link1", "law": math.atan2},
        {
            "kind": is_text,
            "place": is_text,
            "name": is_text,
            "start": is_mapping,
            "fixed": is_mapping,
            "prior": is_mapping,
            "law": callable,
        },
    ),
    "Table": Call(
        lambda: rco.Table,
        lambda: {"d": [-1.0, 0.0, 2.0], "force": [-3.0, 0.0, 8.0]},
        {"d": is_numbers, "v": is_numbers, "force": is_numbers},
    ),
    "Effect.replace": Call(
        lambda: EFFECT.replace,
        dict,
        {
            "kind": is_text,
            "place": is_text,
            "name": or_none(is_text),
            **dict.fromkeys(("start", "fixed", "prior"), or_none(is_mapping)),
            "law": or_none(is_nothing),
        },
        more=("kind", "place", "start", "fixed", "prior", "law", "name"),
    ),
    "Effect.at_port": Call(
        lambda: EFFECT.at_port, lambda: {"port_kind": "mechanical"}, {"port_kind": is_text}
    ),
    "Effect.bounds": Call(
        lambda: EFFECT.bounds, lambda: {"coefficient": "stiffness"}, {"coefficient": is_text}
    ),
    "Effect.start_of": Call(
        lambda: EFFECT.start_of, lambda: {"coefficient": "stiffness"}, {"coefficient": is_text}
    ),
    "describe_effects": Call(
        lambda: rco.describe_effects, lambda: {"effects": [EFFECT]}, {"effects": is_listing}
    ),
    "effect_library": Call(
        lambda: rco.effect_library,
        lambda: {"model": model()},
        {"model": is_transfer_function, "kinds": is_texts, "places": is_texts, "dt": is_positive},
    ),
    "simulate": Call(
        lambda: rco.simulate,
        lambda: {"model": model(), "data": record()},
        {
            "model": is_transfer_function,
            "data": is_nothing,
            "x0": is_state,
            "effects": is_listing,
            "controller": is_transfer_function,
        },
    ),
    "frequency_response_at": Call(
        lambda: rco.frequency_response_at,
        lambda: {"model": model(), "omega": [3.0], "amplitude": 1.0, "harmonics": 3},
        {
            "model": is_transfer_function,
            "omega": is_numbers,
            "amplitude": is_numbers,
            "source": lambda v: is_text(v) or is_number(v),
            "harmonics": is_whole,
            "sweep": is_text,
        },
    ),
    # the loop
    "check": Call(
        lambda: rco.check,
        lambda: {"model": model(), "data": record(), "information": False},
        {
            "model": is_transfer_function,
            "data": is_nothing,
            "information": is_flag,
            "controller": is_transfer_function,
        },
    ),
    "compare": Call(lambda: rco.compare, lambda: {"model": model(), "data": record()}, FIT),
    "black_box": Call(
        lambda: rco.black_box, lambda: {"data": record(), "order": 1}, {"data": is_nothing, "order": is_whole}
    ),
    "explore": Call(lambda: rco.explore, lambda: {"model": model(), "data": record()}, FIT),
    "Comparison.plot": _plot(comparison, kind=is_text, measured=is_nothing, omega=is_numbers),
    "Comparison.report": _report(comparison),
    "Comparison.select": Call(
        _method(comparison, "select"), lambda: {"name": 0}, {"name": lambda v: is_text(v) or is_number(v)}
    ),
    "FrequencyComparison.plot": _plot(in_frequency, omega=is_numbers),
    "FrequencyComparison.report": _report(in_frequency),
    "refine": Call(
        lambda: rco.refine,
        lambda: {"model": model(), "data": record(), "effects": [EFFECT]},
        {**FIT, "substeps": is_whole},
        work="rcorefine.refinement.refine.estimated_motion",
    ),
    "Refinement.bode_plot": _plot(
        refinement, "bode_plot", measured=is_nothing, omega=is_numbers, levels=is_numbers
    ),
    "Refinement.response_plot": _plot(
        refinement, "response_plot", kind=is_text, count=is_whole, seed=is_whole
    ),
    "Refinement.drawn": Call(
        _method(refinement, "drawn"), lambda: {"count": 2}, {"count": is_whole, "seed": is_whole}
    ),
    "Refinement.parameter": Call(
        _method(refinement, "parameter"), lambda: {"name": "stiffness"}, {"name": is_text, "place": is_text}
    ),
    "Refinement.report": _report(refinement, data=is_nothing),
    "Refinement.script": Call(
        _method(refinement, "script"),
        lambda: {"data": record()},
        {"data": is_nothing, "horizon": is_positive},
    ),
    "Refinement.sentences": Call(_method(refinement, "sentences"), dict),
    "Refinement.simulate": Call(
        _method(refinement, "simulate"), lambda: {"data": record()}, {"data": is_nothing, "x0": is_state}
    ),
    "Refinement.simulation_structure": Call(_method(refinement, "simulation_structure"), dict),
    "survey": Call(
        lambda: rco.survey,
        lambda: {"models": model(), "records": {"a": record()}},
        {
            **FIT,
            "models": lambda v: is_transfer_function(v) or is_path(v),
            "records": lambda v: isinstance(v, pathlib.Path) and v.is_dir(),
            "task": is_text,
            "effects": is_text,
            "options": lambda v: is_mapping(v) and not v,
            "reading": lambda v: is_mapping(v) and not v,
        },
        work="rcorefine.fleet.survey.work_off",
    ),
    "Survey.breaches": Call(
        _method(surveyed, "breaches"),
        lambda: {"conditions": {"condition": [{"errors": 0}]}},
        {"conditions": is_nothing},
    ),
    "Survey.of": Call(_method(surveyed, "of"), lambda: {"machine": "a"}, {"machine": is_text}),
    "Survey.plot": _plot(surveyed),
    "Survey.report": Call(
        _method(surveyed, "report"),
        lambda: {"folder": folder() / "survey"},
        {**REPORT, "folder": is_path},
        work="rcorefine.views.survey.write_page",
    ),
    "Survey.sentences": Call(_method(surveyed, "sentences"), dict),
    "Survey.summary": Call(_method(surveyed, "summary"), dict),
    "diagnose": Call(
        lambda: rco.diagnose,
        lambda: {"model": model(), "data": record(), "candidates": [EFFECT]},
        FIT,
        work="rcorefine.diagnosis.diagnose.base_fit",
    ),
    "Diagnosis.law": Call(_method(nameless, "law"), dict),
    "Diagnosis.ordered_records": Call(_method(diagnosis, "ordered_records"), dict),
    "Diagnosis.plot": _plot(diagnosis),
    "Diagnosis.refine": Call(_method(diagnosis, "refine"), dict),
    "Diagnosis.report": _report(diagnosis),
    "Diagnosis.sentences": Call(_method(diagnosis, "sentences"), dict),
    "Diagnosis.suggest_experiment": Call(
        _method(diagnosis, "suggest_experiment"),
        lambda: {"amplitudes": [2.0], "lengths": [2.0], "bands": []},
        {
            "probability": is_share,
            "repeat": is_flag,
            "amplitudes": is_numbers,
            "lengths": is_numbers,
            "bands": is_numbers,
            "sensors": is_texts,
            "costs": is_mapping,
            "largest_input": is_numbers,
        },
        work="rcorefine.diagnosis.experiments._contenders",
    ),
    "ExperimentAdvice.sentences": Call(_method(advice, "sentences"), dict),
    "ExperimentAdvice.plot": _plot(advice),
    "improve": Call(
        lambda: rco.improve,
        lambda: {"model": model(), "data": record(), "candidates": [EFFECT], "max_effects": 1},
        {**FIT, "max_effects": is_whole},
        work="rcorefine.diagnosis.diagnose.base_fit",
    ),
    "Improvement.plot": _plot(improvement, legend_loc=or_none(is_legend)),
    "Improvement.report": _report(improvement, data=is_nothing),
    "Improvement.sentences": Call(_method(improvement, "sentences"), dict),
    "confirm": Call(
        lambda: rco.confirm,
        lambda: {"model": refinement(), "data": [record(), small_record(2)], "candidates": [EFFECT]},
        {**FIT, "force_ratio": is_level},
        work="rcorefine.diagnosis.confirm._alone",
    ),
    "Confirmation.plot": _plot(confirmation),
    "Check.plot": _plot(checked),
    "Refinement.plot": _plot(refinement, data=is_nothing),
    "RCORefiner.plot": _plot(taught, measured=is_nothing, omega=is_numbers),
    "Confirmation.sentences": Call(_method(confirmation, "sentences"), dict),
    "localize_damage": Call(
        lambda: rco.localize_damage,
        lambda: {"model": model(), "data": record()},
        {
            **FIT,
            "damping": is_text,
            "power": is_share,
            "least": is_level,
            "candidates": lambda v: is_listing(v) or is_texts(v),
            "hypotheses": lambda v: is_listing(v) or is_texts(v) or isinstance(v, list | dict),
        },
        work="rcorefine.localization.localize.decide",
    ),
    "DamageMap.plot": _plot(damage_map, kind=is_text),
    "DamageMap.row": Call(
        _method(damage_map, "row"), lambda: {"place": "link1"}, {"place": is_text, "kind": is_text}
    ),
    # on a stream
    "Monitor": Call(
        lambda: rco.Monitor,
        lambda: {"model": model(), "candidates": [EFFECT], "dt": DT, "learn": 200},
        {
            "model": is_nothing,
            "candidates": is_listing,
            "dt": is_positive,
            "false_alarms": is_positive,
            "learn": is_whole,
            "hold": is_text,
            "missing": is_text,
        },
    ),
    "Monitor.load": Call(
        lambda: rco.Monitor.load,
        lambda: {"path": files()["monitor.npz"]},
        {"path": is_path, "laws": is_mapping},
    ),
    "Monitor.plot": _plot(watched),
    "Monitor.reset": Call(_method(monitor, "reset"), dict),
    "Monitor.run": Call(_method(monitor, "run"), lambda: {"data": record()}, {"data": is_nothing}),
    "Monitor.save": Call(
        _method(watched, "save"), lambda: {"path": folder() / "other.npz"}, {"path": is_path}
    ),
    "Monitor.update": Call(
        _method(monitor, "update"), lambda: {"w": 1.0, "y": 0.1}, {"w": is_signal, "y": is_signal}
    ),
    "RCORefiner": Call(
        lambda: rco.RCORefiner,
        lambda: {"model": model().system, "dt": DT, "order": 2},
        {
            "model": is_transfer_function,
            "dt": is_positive,
            "effects": is_listing,
            "form": is_text,
            "noise": is_numbers,
            **dict.fromkeys(("order", "substeps"), is_whole),
            **dict.fromkeys(("learning_rate", "forgetting"), is_positive),
            "disturbance": is_level,
            "use_estimated_states": is_flag,
            "history": is_flag,
            "hold": is_text,
            "missing": is_text,
        },
    ),
    "RCORefiner.paper": Call(
        lambda: rco.RCORefiner.paper,
        lambda: {"model": model().system, "dt": DT, "order": 2, "window": 20},
        {
            "model": is_transfer_function,
            "dt": is_positive,
            **dict.fromkeys(
                ("order", "window", "markov", "static_window", "static_markov", "static_average"), is_whole
            ),
            **dict.fromkeys(("learning_rate", "static_learning_rate"), is_positive),
            "correction_input": is_numbers,
            "correction_feedthrough": is_numbers,
            "use_estimated_states": is_flag,
            "history": is_flag,
            "missing": is_text,
            "scale": lambda v: is_text(v) or is_mapping(v),
        },
    ),
    "RCORefiner (effects)": Call(
        lambda: rco.RCORefiner,
        lambda: {"model": model(), "dt": DT, "effects": [EFFECT], "noise": 0.01},
        {
            "noise": is_numbers,
            "disturbance": is_level,
            "forgetting": is_positive,
            "substeps": is_whole,
            "hold": is_text,
            "effects": is_listing,
        },
    ),
    "RCORefiner.bode_plot": _plot(taught, "bode_plot", measured=is_nothing, omega=is_numbers),
    "RCORefiner.load": Call(
        lambda: rco.RCORefiner.load,
        lambda: {"path": files()["refiner.npz"]},
        {"path": is_path, "laws": is_mapping},
    ),
    "RCORefiner.predict": Call(_method(taught, "predict"), lambda: {"w": 1.0}, {"w": is_signal}),
    "RCORefiner.reset": Call(_method(refiner, "reset"), dict),
    "RCORefiner.run": Call(
        _method(refiner, "run"), lambda: {"data": record()}, {"data": is_nothing, "progress": is_flag}
    ),
    "RCORefiner.save": Call(
        _method(taught, "save"), lambda: {"path": folder() / "other.npz"}, {"path": is_path}
    ),
    "RCORefiner.update": Call(
        _method(refiner, "update"), lambda: {"w": 1.0, "y": 0.1}, {"w": is_signal, "y": is_signal}
    ),
    # the paper's examples
    "Example.simulate": Call(
        _method(example, "simulate"), lambda: {"inputs": np.ones(5)}, {"inputs": is_signal, "model": is_text}
    ),
    "Example.record": Call(
        _method(example, "record"),
        lambda: {"n_samples": 20},
        {
            "n_samples": is_whole,
            "noise": is_level,
            "amplitude": is_positive,
            "rng": is_seed,
        },
    ),
    # the course
    "exercises.hidden_effect": Call(
        lambda: rco.exercises.hidden_effect,
        lambda: {"seed": 3},
        {"seed": is_whole, "plant": is_text, "level": is_whole},
        work="rcorefine.exercises.exercise.hide",
    ),
    "exercises.load_exercise": Call(
        lambda: rco.exercises.load_exercise,
        lambda: {"path": exercise().save(folder() / "exercise.npz")},
        {"path": is_path},
    ),
    "exercises.grade": Call(
        lambda: rco.exercises.grade,
        lambda: {"folder": handed_in(), "exercises": handed_in()},
        {"folder": is_path, "exercises": is_path},
    ),
    "Exercise.check": Call(_method(exercise, "check"), lambda: ANSWER, {"coefficient": is_number}),
    "Exercise.hand_in": Call(
        _method(exercise, "hand_in"),
        lambda: {"path": folder() / "answer.json", "student": "Ada", **ANSWER},
        {"path": is_path, "student": is_text, "coefficient": is_number},
    ),
    "Exercise.save": Call(
        _method(exercise, "save"),
        lambda: {"path": folder() / "exercise.npz"},
        {"path": is_path, "answer": is_flag},
    ),
    "examples.one_dof": Call(lambda: rco.examples.one_dof, dict, EXAMPLE),
    "examples.two_dof": Call(lambda: rco.examples.two_dof, dict, EXAMPLE),
    "examples.rlc": Call(lambda: rco.examples.rlc, dict, EXAMPLE),
    "examples.rlc_parameters": Call(
        lambda: rco.examples.rlc_parameters,
        lambda: {"system": rco.examples.rlc().true},
        {"system": is_nothing, "resistance": is_positive},
    ),
}

simulation = _quiet(lambda: rco.simulate(small_model(), record(), "zero"))
RESULTS: dict[str, Callable[[], Any]] = {
    "AmplitudeResponse": curve,
    "Check": checked,
    "Comparison": comparison,
    "Confirmation": confirmation,
    "DamageMap": damage_map,
    "Diagnosis": diagnosis,
    "FrequencyResponse": response,
    "Improvement": improvement,
    "Measurement": record,
    "Monitor": watched,
    "PhysicalModel": model,
    "RCORefiner": taught,
    "Refinement": refinement,
    "Simulation": simulation,
    "Survey": surveyed,
    "Alarm": alarmed,
    "CheckRow": lambda: checked().rows[0],
    "EstimatedParameter": lambda: refinement().parameters[0],
    "NominalParameter": lambda: model().parameters[0],
    "Port": lambda: model().ports[0],
}
_ANSWERING = [name for name in RESULTS if hasattr(getattr(rco, name), "answer")]
CALLS |= {f"{name}.report": _report(RESULTS[name]) for name in _ANSWERING if f"{name}.report" not in CALLS}
CALLS |= {
    f"{name}.{what}": Call(_method(owner, what), dict)
    for name, owner in RESULTS.items()
    for what in ("to_dict", "to_dataframe", "answer")
    if what != "answer" or name in _ANSWERING
}


def _is_infinite(value: Any) -> bool:
    return isinstance(value, int | float | np.floating) and math.isinf(_float(value))
