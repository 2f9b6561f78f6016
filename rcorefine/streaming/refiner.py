"""`RCORefiner`: two-stage retrospective cost refinement on a stream."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..arguments import as_flag
from ..data.measurement import Measurement
from ..exceptions import RCOError
from ..progress import Progress
from ..results import Options, Result, picture, show
from ..systems.linear import Array, LinearModel
from ..writing import damaged
from .history import CoefficientHistory, History, Summary
from .joint import assembled
from .locks import Locked
from .persistence import check_like, read_file, write_file
from .samples import (
    as_missing,
    as_samples,
    check_samples,
    checked_block,
    checked_record,
    sampled_model,
    whole_block,
)
from .scales import Scales

_CHUNK = 1000


class RCORefiner(Locked, Result):
    """Refine a linear model on measured samples, in two concurrent stages.

    Stage 1 adapts a *dynamic* correction until the output follows; its state estimates the true one.
    Stage 2 fits a *static* correction to that: a refined model of the same order. By default several
    forms of it run as exact filters and compete; `window`, `markov` or a ``static_...`` setting asks
    for the paper's own equations, (23) to (46). Several threads may use it in turn. More in
    ``docs/refiner.md``.

    Parameters
    ----------
    model : StateSpace or object with `.system`
        Initial model. A continuous one is discretized exactly.
    dt : float, optional
        Sampling time in s of the samples; a continuous model needs it.
    static : {"auto", "nonzero", "discrete", "input"} or sequence, optional
        What may change: "nonzero" entries of the model, all of the "discrete" one, the paper's u = theta
        [x; w] through the "input"; "auto": these compete. Or entries (``["A[1,0]"]``), or effects.
    effects : sequence of Effect, optional
        Physical effects, as in ``static=[...]``.
    history : bool, optional
        Keep every sample's course; otherwise memory is constant.
    missing : {"raise", "hold-out"}, optional
        With "hold-out" samples that are NaN or masked are predicted over, not learned from.

    Other Parameters
    ----------------
    order, window, markov, learning_rate : int or float, optional
        Stage 1: memory n_c in samples (5), window p (800; 100 beside the filters), mu Markov parameters
        (20 or more), weight alpha of a change of theta (1e5; larger is slower).
    static_window, static_markov, static_learning_rate, static_average : int or float, optional
        The same of the paper's stage 2 (n_c = 0), and samples that its model averages (two windows).
    correction_input, correction_feedthrough : array_like of shape (n, l_u), (n_y, l_u), optional
        B_u, D_u: where the correction acts; default B and D (zero where B_u is given).
    use_estimated_states : bool, optional
        With False stage 1 does not run; the paper's stage 2 then sees its own model's states.
    scale : "auto" or mapping, optional
        Size of signals: ``{"inputs": ..., "outputs": ...}``, "states", "corrections"; "auto": rms.
    noise : float or array_like of shape (n_y,), optional
        Sensor noise (standard deviation, units of the outputs); else from the innovations.
    hold : {"zoh", "foh"}, optional
        The input between samples.
    disturbance, forgetting, substeps : float, float and int, optional
        Unknown force over the input, rms (0; 0.03 with `forgetting`); share of what is known that a
        sample leaves (1); steps per sample for nonlinear effects (4).

    Raises
    ------
    control.ControlArgument
        If the model is no `StateSpace`, a setting has the wrong type, or settings exclude one another.
    control.ControlDimension
        If B_u, D_u or a scale has the wrong shape.
    ModelError
        If a setting is out of range, dt is missing or contradicts, or the correction reaches no output.

    Examples
    --------
    >>> example = rco.examples.rlc()
    >>> refiner = rco.RCORefiner(example.initial, dt=example.dt).run(example.record())
    >>> print(f"{250e3 / float((refiner.system.C @ refiner.system.B)[0, 0]):.3f} mH")
    55.000 mH
    """

    _latest: Array

    def __init__(
        self,
        model: Any,
        *,
        dt: float | None = None,
        static: str | Sequence[Any] = "auto",
        order: int = 5,
        window: int | None = None,
        markov: int | None = None,
        learning_rate: float | None = None,
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
        effects: Sequence[Any] | None = None,
        noise: ArrayLike | None = None,
        hold: str = "zoh",
        disturbance: float | None = None,
        forgetting: float = 1.0,
        substeps: int | None = None,
    ) -> None:
        # arguments stay as they were given: `save` writes them, `load` builds the refiner from them
        self.model = model
        self.dt = dt
        self.static = static if isinstance(static, str) else _as_tuple(static)
        self.order = order
        self.window = window
        self.markov = markov
        self.learning_rate = learning_rate
        self.static_window = static_window
        self.static_markov = static_markov
        self.static_learning_rate = static_learning_rate
        self.static_average = static_average
        self.correction_input = correction_input
        self.correction_feedthrough = correction_feedthrough
        self.use_estimated_states = use_estimated_states
        self.scale = scale
        self.missing = as_missing(missing)
        self.effects = effects if effects is None else _as_tuple(effects)
        self.noise = noise
        self.hold = hold
        self.disturbance = disturbance
        self.forgetting = forgetting
        self.substeps = substeps
        # discretize the initial model at the sampling time of the stream
        self._sampled = sampled_model(model, dt)
        self._keep = as_flag(history, "history")
        # choose the estimator: joint Kalman filter, forms side by side, or the paper's equations
        given = {name: getattr(self, name) for name in _SETTINGS}
        self._estimator = assembled(given | {"history": history}, self._sampled)
        self.reset()

    def update(self, w: ArrayLike, y: ArrayLike) -> None:
        """Learn from one sample or from a block of samples.

        A call that raises an error changes nothing.

        Parameters
        ----------
        w : array_like of shape (n_w,) or (n_w, N)
            Inputs; a number or (N,) where there is one.
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
        inputs, outputs = checked_record(self._sampled, data, self.hold)
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
        outputs = self._estimator.filter.predict(np.ascontiguousarray(inputs.T))
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
            "settings": {name: getattr(self, name) for name in _SETTINGS} | {"history": self._keep},
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
            refiner = cls(**content["settings"])
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

        It is 0 while the first samples are held back for the scales.
        """
        return self._estimator.n_learned

    @property
    def form(self) -> str:
        """Form of the static correction that the refined model has.

        "paper" by the paper's equations, "coefficients" where they were named; with competing forms
        "nonzero", "discrete", "input", or "initial" where no form predicts better than
        the initial model.
        """
        return self._estimator.static.form

    @property
    def scores(self) -> dict[str, float]:
        """Simulation fit of each form in percent, in a model comparison.

        It refers to the last stretch that the forms had not seen.
        """
        return self._estimator.static.scores

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

        Of the joint filter for white innovations; by the paper's equations the
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
        return self._estimator.filter.parameters

    @property
    def covariance(self) -> Array:
        """Covariance of the coefficients at this sample, shape (p, p).

        Raises
        ------
        RCOError
            By the paper's equations.
        """
        return self._estimator.filter.covariance

    @property
    def discrete_system(self) -> ct.StateSpace:
        """Refined model in discrete time, labels kept."""
        # the filter estimates in discrete time, or discretizes with the hold of the stream
        return self._estimator.static.discrete_system(self._name()).to_statespace()

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


_SETTINGS = tuple(name for name in inspect.signature(RCORefiner).parameters if name != "history")
