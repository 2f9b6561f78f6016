"""`RCORefiner`: two-stage retrospective cost refinement on a stream."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_choice, as_flag, as_list, as_whole
from ..data.measurement import Measurement
from ..effects.bodies import Entry
from ..effects.effect import Effect
from ..exceptions import ModelError, RCOError, warn
from ..models.operating_point import check_stream_hold
from ..models.physical_model import PhysicalModel
from ..progress import Progress
from ..results import Options, Result, picture, show
from ..systems.linear import Array, LinearModel
from ..writing import damaged
from .families import (
    Effects,
    Entries,
    Family,
    FilterSettings,
    all_entries,
    checked_entries,
    checked_settings,
    nonzero_entries,
)
from .forms import INITIAL, Forms
from .history import CoefficientHistory, History, Summary
from .locks import Locked
from .paper import PaperStages
from .persistence import check_like, read_file, write_file
from .samples import (
    Sampled,
    as_missing,
    as_samples,
    check_samples,
    checked_block,
    checked_record,
    sampled_model,
    whole_block,
)
from .scales import Plant, Scales, markov_parameters

_CHUNK = 1000


class RCORefiner(Locked, Result):
    """Refine a linear model on measured samples, in two concurrent stages.

    Stage 1 adapts a *dynamic* correction until the output follows; its state estimates the true one.
    Stage 2 finds a *static* correction: a refined model of the same order. By default it is a Kalman filter
    for the state and the coefficients, in two forms that compete with the initial model; `paper` runs the
    equations (23) to (46) of the paper instead. Several threads may use a refiner in turn. More in
    ``docs/refiner.md``.

    Parameters
    ----------
    model : StateSpace or object with `.system`
        Initial model. A continuous one is discretized exactly.
    dt : float, optional
        Sampling time in s of the samples; a continuous model needs it.
    effects : sequence of Effect or str, optional
        What may change: physical effects, or entries of the matrices such as "A[1,0]".
    form : {"auto", "nonzero", "discrete"}, optional
        Without effects: the "nonzero" entries of the model, or all of the "discrete" one; "auto": these
        compete with each other and with the initial model.
    history : bool, optional
        Keep every sample's course; otherwise memory is constant.
    missing : {"raise", "hold-out"}, optional
        With "hold-out" samples that are NaN or masked are predicted over, not learned from.

    Other Parameters
    ----------------
    noise : float or array_like of shape (n_y,), optional
        Sensor noise (standard deviation, units of the outputs); else from the residual.
    hold : {"zoh", "foh"}, optional
        The input between samples.
    disturbance, forgetting : float, optional
        Unknown force over the input, rms (0; 0.03 with `forgetting`); share of what is known that a
        sample leaves (1).
    substeps : int, optional
        Steps per sample for nonlinear effects.
    order, learning_rate : int or float, optional
        Stage 1: its memory n_c in samples (5), weight alpha of a change of theta (1e5; larger is slower).
    use_estimated_states : bool, optional
        With False stage 1 does not run.
    **old : optional
        Keywords of version 0.2, with a `FutureWarning` that names the new line.

    Raises
    ------
    control.ControlArgument
        If the model is no `StateSpace`, a setting has the wrong type, or settings exclude one another.
    control.ControlDimension
        If the noise has the wrong shape.
    ModelError
        If a setting is out of range, or dt is missing or contradicts.

    Examples
    --------
    >>> example = rco.examples.rlc()
    >>> refiner = rco.RCORefiner(example.initial, dt=example.dt).run(example.record())
    >>> print(f"{250e3 / float((refiner.system.C @ refiner.system.B)[0, 0]):.3f} mH")
    55.000 mH
    """

    _latest: Array
    _estimator: PaperStages | Forms

    def __init__(
        self,
        model: Any,
        *,
        dt: float | None = None,
        effects: Sequence[Any] | None = None,
        form: str = "auto",
        history: bool = False,
        missing: str = "raise",
        noise: ArrayLike | None = None,
        hold: str = "zoh",
        disturbance: float | None = None,
        forgetting: float = 1.0,
        substeps: int | None = None,
        order: int = 5,
        learning_rate: float = 1e5,
        use_estimated_states: bool = True,
        **old: Any,
    ) -> None:
        given = {
            "effects": effects if effects is None else _as_tuple(effects), "form": form, "history": history,
            "missing": missing, "noise": noise, "hold": hold, "disturbance": disturbance,
            "forgetting": forgetting, "substeps": substeps, "order": order, "learning_rate": learning_rate,
            "use_estimated_states": use_estimated_states,
        }  # fmt: skip
        settings, make = modern(given, old) if old else (given, assembled)
        self._begin(model, dt, settings, make)

    @classmethod
    def paper(
        cls,
        model: Any,
        *,
        dt: float | None = None,
        order: int = 5,
        window: int = 800,
        markov: int = 20,
        learning_rate: float = 1e5,
        static_window: int | None = None,
        static_markov: int | None = None,
        static_learning_rate: float | None = None,
        static_average: int | None = None,
        correction_input: ArrayLike | None = None,
        correction_feedthrough: ArrayLike | None = None,
        use_estimated_states: bool = True,
        scale: str | Mapping[str, Any] = "auto",
        history: bool = False,
        missing: str = "raise",
    ) -> RCORefiner:
        """Return a refiner that runs the equations (23) to (46) of the paper.

        Parameters
        ----------
        model, dt, history, missing
            As of the class.
        order, window, markov, learning_rate : int or float, optional
            Stage 1: memory n_c in samples, window p, mu Markov parameters, weight alpha.
        static_window, static_markov, static_learning_rate : int or float, optional
            The same of stage 2, whose n_c is 0; by default those of stage 1.
        static_average : int, optional
            Samples that the refined model averages; by default two windows.
        correction_input, correction_feedthrough : array_like of shape (n, l_u), (n_y, l_u), optional
            B_u, D_u: where the correction acts; default B and D (zero where B_u is given).
        use_estimated_states : bool, optional
            With False stage 1 does not run; stage 2 then sees its own model's states.
        scale : "auto" or mapping, optional
            Size of signals: ``{"inputs": ..., "outputs": ...}``, "states", "corrections"; "auto": rms.

        Returns
        -------
        RCORefiner

        Raises
        ------
        control.ControlArgument, control.ControlDimension, ModelError
            As of the class; also if the correction reaches no output.

        Examples
        --------
        >>> example = rco.examples.rlc()
        >>> refiner = rco.RCORefiner.paper(example.initial, dt=example.dt, **example.settings)
        >>> refiner.form
        'paper'
        """
        given = {
            "order": order, "window": window, "markov": markov, "learning_rate": learning_rate,
            "static_window": static_window, "static_markov": static_markov,
            "static_learning_rate": static_learning_rate, "static_average": static_average,
            "correction_input": correction_input, "correction_feedthrough": correction_feedthrough,
            "use_estimated_states": use_estimated_states, "scale": scale, "history": history,
            "missing": missing,
        }  # fmt: skip
        refiner = cls.__new__(cls)
        refiner._begin(model, dt, given, paper_stages)
        return refiner

    def _begin(
        self, model: Any, dt: float | None, settings: dict[str, Any], make: Callable[..., Any]
    ) -> None:
        # settings stay as they were given: `save` writes them, `load` builds the refiner from them
        self.model, self.dt, self.effects = model, dt, settings.get("effects")
        self._settings, self._paper = settings, make is paper_stages
        self.missing = as_missing(settings["missing"])
        # discretize the initial model at the sampling time of the stream
        self._sampled = sampled_model(model, dt)
        self._keep = as_flag(settings["history"], "history")
        self._estimator = make(model, self._sampled, settings)
        self.reset()

    def update(self, w: ArrayLike | Measurement, y: ArrayLike | None = None) -> None:
        """Learn from one sample or from a block of samples.

        A call that raises an error changes nothing. A block of samples is learned once it is complete: the
        model is up to 64 samples old, less with `forgetting` (see `age`).

        Parameters
        ----------
        w : array_like of shape (n_w,) or (n_w, N), or Measurement
            Inputs; a number or (N,) where there is one. Or a record of inputs and outputs.
        y : array_like of shape (n_y,) or (n_y, N)
            Outputs at the same samples.

        Raises
        ------
        DataError
            NaN or Inf (signal and sample are named), no sample, or an input
            that stays constant over all samples that scales are taken from.
        control.ControlDimension
            Unequal lengths, transposed arrays, wrong number of channels.
        control.ControlArgument
            Complex values or text.
        DivergenceError
            If a correction diverges: when, why, and what to change.

        Warns
        -----
        IdentifiabilityWarning
            With ``effects=``, where the first samples have a constant part that no effect takes: a
            sensor offset distorts the coefficients; estimate an ``"output_offset"`` beside them.
        """
        if isinstance(w, Measurement):
            if y is not None:
                raise ct.ControlArgument("update takes a Measurement, or inputs and outputs, not both")
            w, y = (signals.T for signals in checked_record(self._sampled, w, self._hold, whole=False))
        # a missing input holds its last value
        model, step = self._sampled.initial, self._sampled.step
        latest = None if self.missing == "raise" else self._latest
        # check everything first, so that an error changes nothing
        block = checked_block(model, step, w, y, self._estimator.n_samples, latest)
        self._estimator.take(block)
        # last input, for a gap at the start of the next call
        self._latest = block.inputs[-1].copy()

    def run(self, data: Measurement, progress: bool | None = None) -> RCORefiner:
        """Learn from a whole record.

        Parameters
        ----------
        data : Measurement
            Record with the model's dt; channels are matched by name, by
            position where names are python-control's own.
        progress : bool, optional
            Whether to show a progress bar on standard error. By default in a terminal and in a notebook.

        Returns
        -------
        RCORefiner
            This object.

        Raises
        ------
        DataError
            If an input is constant over the record, or the record is too
            short or not held between samples as the model takes it to be.
        control.ControlDimension
            If channels do not fit.
        control.ControlArgument
            If `data` is not a `Measurement`.
        ModelError
            If dt contradicts the model's.
        DivergenceError
            If a correction diverges; what was learned before that sample is
            kept and readable.

        Notes
        -----
        At the end of a record, samples still held back for the scales are
        learned from, however few.
        """
        # inputs and outputs in the order of the model, (N, signals)
        inputs, outputs = checked_record(self._sampled, data, self._hold)
        with Progress(progress) as bar:
            # blocks of 1,000 samples: the loop over samples is compiled, progress is shown between
            for first in bar.over(range(0, inputs.shape[0], _CHUNK), "refining"):
                part = slice(first, first + _CHUNK)
                self._estimator.take(whole_block(inputs[part], outputs[part]), keep_sound=True)
        # a record shorter than the first milestone is learned from now
        self._estimator.finish()
        return self

    def predict(self, w: ArrayLike) -> Array:
        """Simulate the refined model on further inputs, without learning.

        A free run of `discrete_system`: it starts from the state estimated
        after the last sample and sees no measured output.

        Parameters
        ----------
        w : array_like of shape (n_w,) or (n_w, N)
            Inputs that follow the last sample; a number or (N,) where there
            is one.

        Returns
        -------
        ndarray of shape (n_y, N), or (N,) for one output
            Simulated outputs. Nothing in the refiner changes.

        Raises
        ------
        DataError, control.ControlDimension, control.ControlArgument
            As in `update`.
        """
        # free run from the present state, coefficients frozen
        model = self._sampled.initial
        inputs = as_samples(w, "inputs", model.n_inputs)
        check_samples(inputs, model.input_labels, "input", self.n_samples, self._sampled.step)
        outputs = self._estimator.predict(np.ascontiguousarray(inputs.T))
        return outputs[0] if model.n_outputs == 1 else outputs

    def reset(self) -> None:
        """Forget all samples; settings stay."""
        self._estimator.reset()
        self._latest = np.zeros(self._sampled.initial.n_inputs)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write settings and memory to one file, to go on from later.

        Parameters
        ----------
        path : path-like
            File, by custom ``*.npz``. It is replaced in one step: a crash leaves
            the old file or the new one.

        Raises
        ------
        ModelError
            If the model is neither a `StateSpace` nor a `PhysicalModel`.
        OSError
            If the file cannot be written.

        See Also
        --------
        load
        """
        # settings rebuild the estimator, `state` restores its memory
        content = {
            "what": "refiner",
            "model": self.model,
            "dt": self.dt,
            "settings": self._settings,
            "paper": self._paper,
            "state": self._estimator.state(),
            "latest": self._latest,
        }
        write_file(path, content)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, laws: Mapping[str, Callable[..., Any]] | None = None
    ) -> RCORefiner:
        """Read a refiner that `save` wrote.

        It continues bit by bit as if it had never stopped.

        Parameters
        ----------
        path : path-like
            File.
        laws : mapping of str to callable, optional
            Laws of your own by the label of the effect. Default: those of which this process has
            made an effect already. Loading imports no module.

        Returns
        -------
        RCORefiner
            The refiner, its history included.

        Raises
        ------
        DataError
            If the file is damaged, none of a refiner, or of another version.
        ModelError
            If a law of your own is neither given nor one of this process.

        Examples
        --------
        >>> import tempfile, pathlib
        >>> example = rco.examples.rlc()
        >>> data = example.record()
        >>> refiner = rco.RCORefiner(example.initial, dt=example.dt)
        >>> refiner.update(data.inputs[:, :500], data.outputs[:, :500])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     refiner.save(pathlib.Path(folder) / "state.npz")
        ...     again = rco.RCORefiner.load(pathlib.Path(folder) / "state.npz")
        >>> again.n_samples
        500
        """
        # build a fresh refiner, compare the saved memory with its memory, then take it over
        content = read_file(path, laws)
        with damaged(path):
            make = cls.paper if content["paper"] else cls
            refiner = make(content["model"], dt=content["dt"], **content["settings"])
            check_like(content["latest"], refiner._latest, "latest")
            refiner._estimator.restore(content["state"])
            refiner._latest = content["latest"]
        return refiner

    @property
    def n_samples(self) -> int:
        """Number of samples taken."""
        return self._estimator.n_samples

    @property
    def n_learned(self) -> int:
        """Number of samples learned from.

        It is 0 while the first samples are held back. The others wait until their block is complete.
        """
        return self._estimator.n_learned

    @property
    def age(self) -> int:
        """Number of samples since the last one that `system` was learned from."""
        return self.n_samples - self.n_learned

    @property
    def form(self) -> str:
        """Form of the static correction that the refined model has.

        "paper" by the paper's equations, "coefficients" with effects; with competing forms
        "nonzero", "discrete", or "initial" where neither predicts better than the initial model.
        """
        return self._estimator.form

    @property
    def scores(self) -> dict[str, float]:
        """Simulation fit of each form in percent, in a model comparison.

        It refers to the last stretch that the forms had not seen.
        """
        return self._estimator.scores

    @property
    def scales(self) -> Scales | None:
        """Sizes that stage 1 divides signals by.

        None while they are not known yet.
        """
        return self._estimator.scales

    @property
    def theta(self) -> Array:
        """Dynamic coefficients in the units of the signals.

        The shape is (l_u, (n_c + 1)(n + n_w) + n_c l_u).

        Empty, of shape (0, 0), where stage 1 does not run.
        """
        return self._estimator.dynamic_theta()

    @property
    def static_theta(self) -> Array:
        """Static coefficients, as changes of the initial model.

        They are in the units of the signals.

        By the paper's equations [theta_x, theta_w] of shape (l_u, n + n_w), the mean over the last
        `static_average` samples (`history.theta2` has those of each sample); else those of
        `parameters`, shape (1, p).
        """
        return self._estimator.static_theta()

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations of `static_theta`.

        They are infinite before anything is learned.

        The noise of the sensors may be colored; by the paper's equations they are the
        scatter over the samples that the coefficients are averaged over.
        """
        return self._estimator.standard_deviations()

    @property
    def parameters(self) -> tuple[Any, ...]:
        """One row per coefficient, with its standard deviation at this sample.

        Rows have the fields name, kind, place, initial, value, coefficient,
        std, unit, role and interval (95 %); std is infinite before anything is learned.

        Raises
        ------
        RCOError
            By the paper's equations: their coefficients are no parameters.
        """
        return self._estimator.parameters

    @property
    def covariance(self) -> Array:
        """Covariance of the coefficients at this sample, shape (p, p).

        Raises
        ------
        RCOError
            By the paper's equations.
        """
        return self._estimator.covariance

    @property
    def discrete_system(self) -> ct.StateSpace:
        """Refined model in discrete time, labels kept."""
        # the filter estimates in discrete time, or discretizes with the hold of the stream
        return self._estimator.discrete_system(self._name()).to_statespace()

    @property
    def system(self) -> ct.StateSpace:
        """Refined model: continuous if the initial one is, labels kept.

        Warns
        -----
        ConversionWarning
            If the refined discrete model has no continuous counterpart, as with a
            pole at zero: the nearest one of the same order is given, and
            `discrete_system` is exact.
        """
        return self._estimator.system(self._name()).to_statespace()

    @property
    def history(self) -> History | CoefficientHistory:
        """Course of both stages, sample by sample.

        Raises
        ------
        RCOError
            If it was not asked for with ``history=True``.
        """
        # constant memory by default
        if not self._keep:
            raise RCOError(
                "no history was kept: build the refiner with RCORefiner(..., history=True) and run it again "
                "(by default none is kept, so that a stream of any length takes constant memory)"
            )
        found: History | CoefficientHistory = self._estimator.history()
        return found

    @picture
    def bode_plot(
        self, measured: Any = None, omega: ArrayLike | None = None, **options: Unpack[Options]
    ) -> ct.ControlPlot:
        """Draw a Bode plot of the initial and the refined model.

        The measured response is drawn beside them if it is given.

        The band about the refined curve is two standard deviations wide, as the coefficients
        are known; by the paper's equations there is none.

        Parameters
        ----------
        measured : Measurement or FrequencyResponse, optional
            Record, or its frequency response; drawn as dots with a band, and
            a row with the relative error of both models is added.
        omega : array_like of shape (n_omega,), optional
            Frequencies in rad/s.
        ax : array of Axes, optional
            Axes to draw in, shape (2 n_y, n_w), with `measured` (3 n_y, n_w).
        label : list of str, optional
            Labels of the two models.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        return show(self, "bode_plot", measured, omega, **options)

    plot = bode_plot

    def _summary(self) -> Summary:
        """Cells and sentences of `str(refiner)`."""
        return self._estimator.summary()

    @property
    def _hold(self) -> str:
        """Hold of the inputs."""
        return str(self._settings.get("hold", "zoh"))

    def _name(self) -> str:
        return f"{self._sampled.initial.name}$refined"

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        if isinstance(self.model, ct.StateSpace):  # holds a lambda, which cannot be pickled
            state["model"] = self._sampled.initial
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if isinstance(self.model, LinearModel):
            self.model = self.model.to_statespace()

    def __repr__(self) -> str:
        return f"<RCORefiner of {self._sampled.initial.name!r}: {self.n_learned} samples learned>"


def _as_tuple(items: Any) -> tuple[Any, ...]:
    """One item, or several, as a tuple."""
    # a string or an Effect alone counts as one item
    return tuple(np.atleast_1d(np.array(items, dtype=object)))


def _as_items(items: Any) -> list[Any]:
    return [items] if isinstance(items, str | Effect) else as_list(items, "effects", "entries or effects")


_BESIDE = {"window": 100, "markov": 20}  # stage 1 beside the filter: a short window costs less
_MOST = 150  # coefficients of a form that takes part in a comparison unasked
_PAPERS = ("window", "markov", "static_window", "static_markov", "static_learning_rate",
           "static_average")  # fmt: skip
_STAGE_ONE = ("correction_input", "correction_feedthrough", "scale")


def modern(given: dict[str, Any], old: dict[str, Any]) -> tuple[dict[str, Any], Callable[..., Any]]:
    """Settings for keywords of version 0.2, and what they run.

    Raises
    ------
    TypeError
        If a keyword is unknown.
    control.ControlArgument
        If keywords exclude one another.

    Warns
    -----
    FutureWarning
        With the line that replaces them.
    """
    if unknown := sorted(set(old) - {"static", *_PAPERS, *_STAGE_ONE}):
        raise TypeError(f"RCORefiner has no argument {unknown[0]!r}")
    static, papers = old.pop("static", "auto"), [name for name in _PAPERS if old.get(name) is not None]
    form, effects = static if isinstance(static, str) else "auto", None if isinstance(static, str) else static
    if given["effects"] is not None and (effects is not None or form != "auto"):
        raise ct.ControlArgument("effects= and static= name the same thing; give effects=")
    effects = given["effects"] if effects is None else _as_tuple(effects)
    if papers and effects is None and form == "auto":
        return _papers_settings(given, old, papers[0]), paper_stages
    _check_forms(form, papers)
    line = f"effects={list(effects)!r}" if effects is not None else f"form={form!r}"
    _outdated(f"use RCORefiner(model, dt=..., {line})")
    return given | {"effects": effects, "form": form} | old, assembled


def _check_forms(form: str, papers: list[str]) -> None:
    """Refuse settings of the paper for a form, and the form that is gone."""
    if wrong := [name for name in papers if name in _PAPERS[2:]]:
        raise ct.ControlArgument(f"{wrong[0]} is a setting of the paper's static stage: use RCORefiner.paper")
    if form == "input":
        raise ct.ControlArgument(
            'the form "input" is gone: use RCORefiner.paper, or form="discrete", which contains it'
        )


def _papers_settings(given: dict[str, Any], old: dict[str, Any], asked: str) -> dict[str, Any]:
    """Settings of `RCORefiner.paper` for keywords of version 0.2."""
    filters = [name for name in ("noise", "disturbance", "substeps") if given[name] is not None]
    filters += [name for name, value in (("hold", "zoh"), ("forgetting", 1.0)) if given[name] != value]
    if filters:
        raise ct.ControlArgument(
            f"{filters[0]} is a setting of the filter, {asked} one of the paper's equations; leave "
            "one of the two out"
        )
    shared = ("order", "learning_rate", "use_estimated_states", "history", "missing")
    found = {name: given[name] for name in shared} | old
    found |= {name: value for name, value in (("window", 800), ("markov", 20)) if found.get(name) is None}
    # version 0.2 averaged 800 samples unless a window was given
    if all(old.get(name) is None for name in ("static_average", "window", "static_window")):
        found["static_average"] = 800
    _outdated(f"use RCORefiner.paper(model, dt=..., {asked}=...)")
    names = [name for name in inspect.signature(RCORefiner.paper).parameters if name not in ("model", "dt")]
    return dict.fromkeys(names) | {"scale": "auto"} | found


def _outdated(line: str) -> None:
    warn(f"keywords of version 0.2: {line}", FutureWarning)


def paper_stages(model: Any, sampled: Sampled, given: dict[str, Any]) -> PaperStages:
    """Both stages by the paper's equations."""
    return PaperStages(sampled, given, as_flag(given["history"], "history"))


def assembled(model: Any, sampled: Sampled, given: dict[str, Any]) -> Forms:
    """Filters for these settings, and stage 1 beside them."""
    effects, form, initial = given["effects"], given["form"], sampled.initial
    if effects is not None and form != "auto":
        raise ct.ControlArgument("effects= and form= name the same thing; give one of them")
    form = as_choice(form, "form", ("auto", "nonzero", "discrete"))
    if given["substeps"] is not None:
        as_whole(given["substeps"], "substeps", least=1, error=ModelError)
    step = 1.0 if sampled.step is None else sampled.step
    settings = checked_settings(
        initial.n_outputs, step, *(given[name] for name in ("hold", "noise", "disturbance", "forgetting"))
    )
    families = _families(model, sampled, given, form, settings)
    first, silent = _stage_one(sampled, given)
    return Forms(families, first, as_flag(given["history"], "history"), silent)


def _families(
    model: Any, sampled: Sampled, given: dict[str, Any], form: str, settings: FilterSettings
) -> dict[str, Family]:
    """Models with coefficients that take part, by the names of their forms."""
    effects, substeps, initial = given["effects"], given["substeps"], sampled.initial
    items = None if effects is None else _as_items(effects)
    if items is None or (items and all(isinstance(item, str) for item in items)):
        if substeps is not None:
            raise ct.ControlArgument("substeps is a setting of nonlinear effects; give effects=[...]")
        physical = getattr(model, "physical_model", model)
        if isinstance(physical, PhysicalModel):
            check_stream_hold(physical, settings.hold)
        if items is None:
            return _forms(form, sampled, settings)
        return {"coefficients": Entries(initial, initial, checked_entries(initial, items), settings, 0.1)}
    items = [Effect(Entry.name, item) if isinstance(item, str) else item for item in items]
    return {"coefficients": Effects(model, items, settings, substeps)}


def _forms(form: str, sampled: Sampled, settings: FilterSettings) -> dict[str, Family]:
    """Return the forms that take part, and the initial model."""
    initial, discrete = sampled.initial, sampled.discrete
    found: dict[str, Family] = {}
    if form in ("auto", "nonzero"):
        found["nonzero"] = Entries(initial, initial, nonzero_entries(initial), settings, 0.0, one_to_one=True)
    if form in ("auto", "discrete"):
        if settings.hold == "zoh" or not initial.is_continuous:
            names = all_entries(discrete)
            found["discrete"] = Entries(initial, discrete, names, settings, 0.1, one_to_one=True)
        elif form == "discrete":
            raise ModelError("form='discrete' needs a held input; leave hold out, or take form='nonzero'")
    # a form with too many coefficients takes part on request only
    if form == "auto":
        found = {name: family for name, family in found.items() if len(family.labels) <= _MOST}
    found = {name: family for name, family in found.items() if family.labels}
    return found | {INITIAL: Entries(initial, initial, [], settings, 0.0)}


def _stage_one(sampled: Sampled, given: dict[str, Any]) -> tuple[PaperStages | None, str]:
    """Stage 1 beside the filter, or why there is none."""
    if not as_flag(given["use_estimated_states"], "use_estimated_states"):
        return None, ""
    none = dict.fromkeys((*_PAPERS, *_STAGE_ONE)) | {"scale": "auto"}
    given = none | _BESIDE | {name: value for name, value in given.items() if value is not None}
    # Markov parameters: does each input act on an output within n samples?
    m = sampled.discrete
    shown = markov_parameters(Plant(m.A, m.B, m.B, m.C, m.D, m.D), m.n_states + 1).any(axis=(0, 1))
    given_path = given["correction_input"] is not None or given["correction_feedthrough"] is not None
    if not given_path and not shown.all():
        return None, "Stage 1 does not run: an input affects no output, so it cannot correct any."
    return PaperStages(sampled, given, given["history"], beside=True), ""
