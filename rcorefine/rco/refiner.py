"""`RCORefiner`: both stages of retrospective cost model refinement on a stream."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..exceptions import DataError, ModelError, RCOError
from ..measurement import Measurement
from ..systems.conversion import d2c
from ..systems.linear import Array, LinearModel
from . import summary
from .checks import as_flag, as_samples, as_size, check_samples
from .effects_history import EffectsHistory
from .effects_setup import make_effects_setup
from .gaps import Block, as_missing, block_with_gaps, take_over_gaps, whole_block
from .history import History
from .kernels import Record
from .memory import Memory, begin
from .persistence import read_file, write_file
from .physical_part import PhysicalPart, joined
from .realization import refined
from .samples import checked_block, checked_record
from .scaling import Scales
from .setup import as_settings, make_setup
from .stage import in_units, regressor_scale
from .stream import Diverged, take, take_until

__all__ = ["RCORefiner"]

_CHUNK = 1000
_SETTINGS = (
    "model", "dt", "order", "window", "markov", "learning_rate", "static_order", "static_window",
    "static_markov", "static_learning_rate", "static_average", "correction_input",
    "correction_feedthrough", "use_estimated_states", "scale", "missing", "effects", "noise", "hold",
    "disturbance", "forgetting", "substeps",
)  # fmt: skip


class RCORefiner:
    """Refine a linear model on measured samples, in two concurrent stages.

    Stage 1 puts a *dynamic* correction u = theta1 psi1 in feedback with the
    model and adapts it until the simulated output follows the measured one;
    its state then estimates the true state. Stage 2 fits a *static*
    correction u = theta2 [x; w] to those states, which turns the model into
    A + B_u theta_x, B + B_u theta_w of the same order. Both minimize the
    retrospective cost over a sliding window, sample by sample.

    Parameters
    ----------
    model : StateSpace or object with `.system`
        Initial model. A continuous one is discretized exactly, its input
        held between samples (zero-order hold).
    dt : float, optional
        Sampling time in s of the samples; a continuous model needs it.
    order : int, optional
        n_c, memory of the dynamic correction in samples, 0 or more.
    window : int, optional
        p, samples in the sliding window, 1 or more.
    markov : int, optional
        mu, number of Markov parameters of the path u -> y, counted from the
        first that is not zero (above 1e-10 of its terms). Raise it where
        that path has zeros outside the unit circle.
    learning_rate : float, optional
        alpha, weight of the change of theta; larger is slower. Signals have
        unit size inside, so that it does not depend on units.
    static_order : int, optional
        n_c of stage 2; above 0 the refined model gets more states.
    static_window, static_markov : int, optional
        p and mu of stage 2; default those of stage 1.
    static_learning_rate : float, optional
        alpha of stage 2; default that of stage 1.
    static_average : int, optional
        The refined model takes the mean of the static coefficients over that
        many of the last samples, default two windows. The paper takes the
        last ones (1), which see one window only: with noise, or where the
        correction cannot be exact, 5 to 10 windows scatter several times less.
    correction_input : array_like of shape (n,) or (n, l_u), optional
        B_u, where the correction acts on the state (in continuous time for a
        continuous model). Default: B of the model.
    correction_feedthrough : array_like of shape (n_y,) or (n_y, l_u), optional
        D_u, how it acts on the outputs directly. Default: D of the model
        where `correction_input` is not given, else zero.
    use_estimated_states : bool, optional
        With False the parameter stage runs without stage 1, on the states of
        its own model (the paper's figure 6); stage 1 then stays the initial
        model.
    scale : "auto" or mapping, optional
        Typical size of the signals: ``{"inputs": ..., "outputs": ...}``, one
        number or one per signal, and optionally "states" and "corrections".
        With "auto" they are the rms values of the first samples, see Notes.
    history : bool, optional
        Keep z, theta and x of every sample; otherwise memory is constant.
    missing : {"raise", "hold-out"}, optional
        With "hold-out" samples that are NaN or masked are predicted over and
        not learned from; one of several sensors may drop out.
    effects : sequence of Effect, optional
        Physical effects for the static stage, estimated in continuous time
        from a continuous model; see Notes. The settings below are theirs.
    noise : float or array_like of shape (n_y,), optional
        Sensor noise (standard deviation, units of the outputs); estimated from
        the innovations where it is not declared.
    hold : {"zoh", "foh"}, optional
        The input between samples: held, or linear.
    disturbance : float, optional
        Unknown force on the model over the measured input, rms. With 0 (the
        default) all that is not sensor noise is explained by the effects; 0.03
        with `forgetting`, since a certain state follows no change.
    forgetting : float, optional
        Share of what is known along the direction that a sample informs about
        which it leaves standing; 1 forgets nothing, 0.998 follows changes over
        about 500 samples. Without excitation nothing is forgotten.
    substeps : int, optional
        Steps per sample for nonlinear effects, default 4 (second order).

    Attributes
    ----------
    n_samples : int
        Number of samples taken.
    n_learned : int
        Number of samples learned from: 0 while the first are held back.

    Raises
    ------
    control.ControlArgument
        If the model is no `StateSpace` (the message says what to convert) or
        a setting has the wrong type.
    control.ControlDimension
        If B_u, D_u or a scale has the wrong shape.
    ModelError
        If a setting is out of range (n_c < 0, p < 1, mu < 1, alpha <= 0), a
        continuous model comes without dt, dt contradicts the model's, or
        the correction reaches no output.

    Notes
    -----
    *Scales.* With ``scale="auto"`` the first ``max(window, 50)`` samples are
    held back, then learned all at once; so scales are causal and do not
    depend on how the stream is cut into blocks. Where an input is still
    constant, or a signal's rms over the second half of them is more than 3
    times that over the first half, twice as many are held back, and so on up
    to 16 times. States are scaled by the rms of the initial model's states
    on these inputs; a correction by the size that first moves the outputs
    by theirs (its first Markov parameter is 1). Until then `system` is the
    initial model. With declared scales learning starts at once.

    *Order of coefficients.* psi = [x(k) ... x(k-n_c), w(k) ... w(k-n_c),
    u(k-1) ... u(k-n_c)]; w also reaches the model through B, so theta = 0 is
    the initial model.

    *Effects.* The static stage then is a Kalman filter for state and
    coefficients jointly, linearized about the present refined model, which
    is discretized anew where a coefficient has moved by its standard
    deviation. Its gain falls as the model improves. The first 2048 samples
    are kept, and gone over again each time that their number has doubled,
    since a wrong start spoils what is learned from them; later samples are
    seen once. Stage 1 runs beside it (not with
    ``use_estimated_states=False``); where it diverges it stops, which
    `str` says and does no harm to the effects.

    *What to expect.* The static correction is exact only where the
    uncertainty is matched, i.e. lies in the columns of B_u.

    *Numerics.* The step is theta -= P Phi'(f + Phi theta), P updated by two
    rank-1 changes per output and sample and rebuilt every 10 windows.

    References
    ----------
    "Damage localization for structural health monitoring using retrospective
    cost model refinement", equations (23) to (46).

    Examples
    --------
    >>> example = rco.examples.rlc()
    >>> refiner = rco.RCORefiner(example.initial, dt=example.dt, static_learning_rate=1.0)
    >>> _ = refiner.run(example.record())
    >>> inductance = 250.0 / float((refiner.system.C @ refiner.system.B)[0, 0])
    >>> print(f"{1e3 * inductance:.3f} mH")
    55.000 mH
    """

    def __init__(
        self,
        model: Any,
        *,
        dt: float | None = None,
        order: int = 5,
        window: int = 100,
        markov: int = 1,
        learning_rate: float = 100.0,
        static_order: int = 0,
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
        self.model = model
        self.dt = dt
        self.order = order
        self.window = window
        self.markov = markov
        self.learning_rate = learning_rate
        self.static_order = static_order
        self.static_window = static_window
        self.static_markov = static_markov
        self.static_learning_rate = static_learning_rate
        self.static_average = static_average
        self.correction_input = correction_input
        self.correction_feedthrough = correction_feedthrough
        self.use_estimated_states = use_estimated_states
        self.scale = scale
        self.missing = as_missing(missing)
        self.effects = effects if effects is None else tuple(np.atleast_1d(np.array(effects, dtype=object)))
        self.noise = noise
        self.hold = hold
        self.disturbance = disturbance
        self.forgetting = forgetting
        self.substeps = substeps

        settings = as_settings(
            order,
            window,
            markov,
            learning_rate,
            static_order,
            static_window,
            static_markov,
            static_learning_rate,
        )
        if static_average is None:
            static_average = 2 * (window if static_window is None else static_window)
        average = as_size(static_average, "static_average", 1, "samples to average over")
        estimated = as_flag(use_estimated_states, "use_estimated_states")
        self._keep = as_flag(history, "history")
        self._setup = make_setup(
            model, dt, settings, correction_input, correction_feedthrough, estimated, average, scale
        )
        self._physical = self._physical_part()
        self.reset()

    def _physical_part(self) -> PhysicalPart | None:
        given = {
            "noise": self.noise is not None,
            "hold": self.hold != "zoh",
            "disturbance": self.disturbance is not None,
            "forgetting": self.forgetting != 1.0,
            "substeps": self.substeps is not None,
        }
        if self.effects is None:
            unused = [name for name, is_given in given.items() if is_given]
            if unused:
                raise ct.ControlArgument(
                    f"{unused[0]} is a setting of physical effects; give effects=[...], or leave it out"
                )
            return None
        setup = make_effects_setup(
            self.model,
            self.effects,
            self._setup.step,
            hold=self.hold,
            noise=self.noise,
            disturbance=self.disturbance,
            forgetting=self.forgetting,
            substeps=self.substeps,
        )
        return PhysicalPart(setup, self._keep)

    # -- streaming ---------------------------------------------------------------------------------

    def update(self, w: ArrayLike, y: ArrayLike) -> None:
        """Learn from one sample, or from a block of samples.

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

        Notes
        -----
        A call that raises changes nothing.
        """
        if self.missing == "raise":
            inputs, outputs = checked_block(self._setup, w, y, self.n_samples)
            if self._physical is None:
                self._commit(self._taken(inputs, outputs))
                return
            beside = self._setup.estimated and not self._stopped
            if inputs.shape[0] == 1 and not beside and self._physical.one(inputs, outputs):
                self._latest = inputs[0]
                return
            block = whole_block(inputs, outputs)
        else:
            block = block_with_gaps(self._setup, w, y, self.n_samples, self._latest)
        self._take_block(block)

    def run(self, data: Measurement, progress: bool = False) -> RCORefiner:
        """Learn from a whole record.

        Parameters
        ----------
        data : Measurement
            Record with the model's dt; channels are matched by name, by
            position where names are python-control's own.
        progress : bool, optional
            Show a progress bar.

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
        inputs, outputs = checked_record(self._setup, data)
        show = as_flag(progress, "progress")
        if self._physical is not None:
            for first in _chunks(inputs.shape[0], show):
                part = slice(first, first + _CHUNK)
                self._take_block(whole_block(inputs[part], outputs[part]))
            self._physical.finish()
            return self
        for first in _chunks(inputs.shape[0], show):
            self._take_while_bounded(inputs[first : first + _CHUNK], outputs[first : first + _CHUNK])
        if self._memory.tuned is None:
            self._take_while_bounded(inputs[:0], outputs[:0], last=True)
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
        inputs = as_samples(w, "inputs", self._setup.initial.n_inputs)
        check_samples(inputs, self._setup.initial.input_labels, "input", self.n_samples, self._setup.step)
        if self._physical is not None:
            outputs = self._physical.predict(np.ascontiguousarray(inputs.T))
            return outputs[0] if outputs.shape[0] == 1 else outputs
        model, x = self._refined(), self._present_state()
        outputs = np.empty((model.n_outputs, inputs.shape[1]))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(inputs.shape[1]):
                outputs[:, k] = model.C @ x + model.D @ inputs[:, k]
                x = model.A @ x + model.B @ inputs[:, k]
        return outputs[0] if model.n_outputs == 1 else outputs

    def reset(self) -> None:
        """Forget all samples; settings stay."""
        self._memory = begin(
            self._setup.plant,
            self._setup.delay,
            self._setup.settings,
            self._setup.average,
            self._setup.scales,
        )
        self._records: list[tuple[Record, Array]] = []
        self._latest = np.zeros(self._setup.initial.n_inputs)
        self._stopped: str = ""
        if self._physical is not None:
            self._physical.reset()

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
        part = self._physical
        content = {
            "settings": {name: getattr(self, name) for name in _SETTINGS} | {"history": self._keep},
            "memory": self._memory,
            "records": self._records,
            "latest": self._latest,
            "stopped": self._stopped,
            "physical": None if part is None else [part.memory, part.records],
        }
        write_file(path, content)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, laws: Mapping[str, Callable[..., Any]] | None = None
    ) -> RCORefiner:
        """Read a refiner that `save` wrote; it goes on as if it had never stopped, bit by bit.

        Parameters
        ----------
        path : path-like
            File.
        laws : mapping of str to callable, optional
            Functions of custom effects by their label, since no file holds a function.

        Returns
        -------
        RCORefiner
            The refiner, its history included.

        Raises
        ------
        DataError
            If the file is damaged, none of a refiner, or of another version.
        ModelError
            If the law of a custom effect is not given.

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
        content = read_file(path, laws)
        refiner = cls(**content["settings"])
        refiner._memory = content["memory"]
        refiner._records = content["records"]
        refiner._latest = content["latest"]
        refiner._stopped = content["stopped"]
        if refiner._physical is not None:
            refiner._physical.memory, refiner._physical.records = content["physical"]
        return refiner

    # -- results -----------------------------------------------------------------------------------

    @property
    def n_samples(self) -> int:
        """Number of samples taken."""
        return self._memory.n_samples if self._physical is None else self._physical.memory.n_samples

    @property
    def n_learned(self) -> int:
        """Number of samples learned from: 0 while the first are held back for the scales."""
        if self._physical is not None:
            return self.n_samples if self._physical.memory.rounds else 0
        return self._memory.n_samples - len(self._memory.inputs)

    @property
    def scales(self) -> Scales | None:
        """Sizes that signals are divided by, None while they are not known yet."""
        return None if self._memory.tuned is None else self._memory.tuned.scales

    @property
    def theta(self) -> Array:
        """Dynamic coefficients, shape (l_u, (n_c + 1)(n + n_w) + n_c l_u), in the units of the signals."""
        return self._theta(0)

    @property
    def static_theta(self) -> Array:
        """Static coefficients [theta_x, theta_w], shape (l_u, n + n_w), in the units of the signals.

        With effects their coefficients, shape (1, p).

        Those of the refined model: the mean over the last `static_average`
        samples. `history.theta2` has those of each sample.
        """
        return self._theta(1) if self._physical is None else self._physical.theta[None]

    @property
    def parameters(self) -> tuple[Any, ...]:
        """With effects: one row per coefficient, with its standard deviation at this sample.

        Rows have the fields name, kind, place, initial, value, coefficient,
        std, unit, role and interval (95 %); std is infinite before anything is learned.

        Raises
        ------
        RCOError
            Without effects: the paper's coefficients are no physical parameters.
        """
        return self._effects_only("parameters").parameters

    @property
    def covariance(self) -> Array:
        """With effects: covariance of the coefficients at this sample, shape (p, p).

        Raises
        ------
        RCOError
            Without effects.
        """
        return self._effects_only("covariance").covariance

    def _effects_only(self, what: str) -> PhysicalPart:
        if self._physical is None:
            raise RCOError(
                f"{what} belong to physical effects; build the refiner with effects=[...] "
                "(static_theta has the paper's coefficients)"
            )
        return self._physical

    @property
    def discrete_system(self) -> ct.StateSpace:
        """Refined model in discrete time, labels kept."""
        if self._physical is not None:
            return self._physical.discrete_system(self._name())
        return self._refined().to_statespace()

    @property
    def system(self) -> ct.StateSpace:
        """Refined model: continuous if the initial one is, labels kept.

        Raises
        ------
        ModelError
            If the refined discrete model has no continuous counterpart (yet),
            as with a pole at zero; `discrete_system` is there nevertheless.
        """
        if self._physical is not None:
            return self._physical.system(self._name())
        if not self._setup.initial.is_continuous:
            return self.discrete_system
        if not self._theta(1).any():
            return self._setup.initial.with_arrays(name=self._name()).to_statespace()
        return d2c(self.discrete_system)

    @property
    def history(self) -> History | EffectsHistory:
        """Course of both stages, sample by sample; with effects, of their coefficients.

        Raises
        ------
        RCOError
            If it was not asked for with ``history=True``.
        """
        if not self._keep:
            raise RCOError(
                "no history was kept: build the refiner with RCORefiner(..., history=True) and run it again "
                "(it is off by default so that a stream of any length takes constant memory)"
            )
        if self._physical is not None:
            return self._effects_history(self._physical)
        return summary.assemble_history(
            self._records, self._setup.initial, self._setup.step, self._setup.theta_shapes
        )

    def bode_plot(
        self,
        measured: Any = None,
        omega: ArrayLike | None = None,
        *,
        ax: Any = None,
        label: str | list[str] | None = None,
        title: str | None = None,
        legend_loc: str | bool | None = None,
        rcParams: dict[str, Any] | None = None,
        show_legend: bool | None = None,
    ) -> ct.ControlPlot:
        """Bode plot of the initial and the refined model, beside the measured response.

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
        title : str, optional
            Title of the figure.
        legend_loc : str or False, optional
            Place of the legend, as in matplotlib; False for none.
        rcParams : dict, optional
            Matplotlib settings on top of `control.rcParams`.
        show_legend : bool, optional
            Force the legend on or off.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        from ..reporting.bode import bode_comparison

        return bode_comparison(
            [("initial", self._setup.initial), ("refined", self.system)],
            measured,
            omega,
            ax=ax,
            label=label,
            title=title,
            legend_loc=legend_loc,
            rcParams=rcParams,
            show_legend=show_legend,
        )

    def __str__(self) -> str:
        return summary.text(self._summary(), left=3 if self._physical else 1)

    def _repr_html_(self) -> str:
        return summary.html(self._summary())

    def __repr__(self) -> str:
        return f"<RCORefiner of {self._setup.initial.name!r}: {self.n_learned} samples learned>"

    def __getstate__(self) -> dict[str, Any]:
        state = dict(self.__dict__)
        if isinstance(self.model, ct.StateSpace):  # holds a lambda, which cannot be pickled
            state["model"] = self._setup.initial
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if isinstance(self.model, LinearModel):
            self.model = self.model.to_statespace()

    # -- inside ---------------------------------------------------------------------------------

    def _commit(self, taken: tuple[Memory, Record | None, Array]) -> None:
        self._memory, record, outputs = taken
        if self._keep and record is not None:
            self._records.append((record, outputs.copy()))

    def _take_block(self, block: Block) -> None:
        """Take a block that may have gaps; all of it or nothing."""
        part = self._physical
        latest = block.inputs[-1].copy()
        if part is None:
            memory, records = take_over_gaps(self._setup, self._memory, block, keep=self._keep)
            self._memory, self._latest = memory, latest
            self._records += records
            return
        beside = self._setup.estimated and not self._stopped
        record = beside and not block.whole
        taken = part.taken(block.inputs, block.known, block.outputs, block.use, record)
        if beside:
            outputs = block.outputs
            if not block.whole:
                ahead = taken[1].predicted
                outputs = np.where(block.use, outputs, np.where(np.isfinite(ahead), ahead, 0.0))
            try:
                self._commit(self._taken(block.inputs, outputs))
            except (Diverged, DataError) as error:
                self._stopped = f"Stage 1 stopped by sample {self.n_samples + len(outputs)}: {error}"
        part.commit(taken, block.outputs, block.use)
        self._latest = latest

    def _effects_history(self, part: PhysicalPart) -> EffectsHistory:
        setup, lay = part.setup, part.setup.layout
        model = self._setup.initial
        coefficients = joined([r.theta for r, _ in part.records], lay.p)
        y = joined([y for _, y in part.records], lay.ny)
        beside = summary.assemble_history(self._records, model, setup.dt, self._setup.theta_shapes)
        n_samples = y.shape[1]

        def padded(values: Array) -> Array:
            return np.pad(values, ((0, 0), (0, n_samples - values.shape[1])), constant_values=np.nan)

        return EffectsHistory(
            timepts=np.arange(n_samples, dtype=np.float64) * setup.dt,
            coefficients=coefficients,
            z1=padded(beside.z1),
            z2=joined([r.predicted for r, _ in part.records], lay.ny) - y,
            x_D=padded(beside.x),
            x=joined([r.x for r, _ in part.records], lay.n),
            y=y,
            names=tuple(q.label for q in setup.bare.parameters),
            output_labels=model.output_labels,
        )

    def _take_while_bounded(self, inputs: Array, outputs: Array, last: bool = False) -> None:
        """Take a chunk of a record; where it diverges, keep what was learned before."""
        try:
            self._commit(self._taken(inputs, outputs, last))
        except Diverged as error:
            self._commit(take_until(self._setup, self._memory, inputs, outputs, error, keep=self._keep))
            raise

    def _taken(
        self, inputs: Array, outputs: Array, last: bool = False
    ) -> tuple[Memory, Record | None, Array]:
        return take(self._setup, self._memory, inputs, outputs, keep=self._keep, last=last)

    def _theta(self, stage: int) -> Array:
        memory = self._memory
        if memory.tuned is None:
            return np.zeros(self._setup.theta_shapes[stage])
        theta = memory.stages[0].theta if stage == 0 else memory.static_theta()
        return in_units(theta, memory.tuned.scales, self._setup.settings[stage].order)

    def _name(self) -> str:
        return f"{self._setup.initial.name}$refined"

    def _refined(self) -> LinearModel:
        order = self._setup.settings[1].order
        return refined(self._setup.discrete, self._setup.plant, self._theta(1), order, self._name())

    def _present_state(self) -> Array:
        """State of the refined model after the last sample, in the units of the states."""
        memory, order = self._memory, self._setup.settings[1].order
        n, n_w, l_u = (
            self._setup.initial.n_states,
            self._setup.initial.n_inputs,
            self._setup.plant.Bu.shape[1],
        )
        if memory.tuned is None:
            if order > 0:
                raise ModelError(
                    "predict with static_order > 0 needs the scales: it works once the first "
                    f"{self._setup.warm_up} samples are learned, or with scale={{...}} declared"
                )
            x = np.zeros(n)
            for w in memory.inputs:
                x = self._setup.plant.A @ x + self._setup.plant.B @ w
            return x
        scales, stage = memory.tuned.scales, memory.stages[1]
        x = memory.stages[0 if self._setup.estimated else 1].x * scales.states
        if order == 0:
            return x
        psi = stage.psi * regressor_scale(scales.states, scales.inputs, scales.corrections, order)
        first_w, first_u = (order + 1) * n, (order + 1) * (n + n_w)
        latest = stage.past_u[stage.counters[3]] * scales.corrections
        past_u = np.concatenate([latest, psi[first_u : first_u + (order - 1) * l_u]])
        return np.concatenate([x, psi[: order * n], psi[first_w : first_w + order * n_w], past_u])

    def _summary(self) -> summary.Summary:
        if self._physical is not None:
            return summary.summarize_effects(self._setup.initial, self._physical, self._stopped)
        return summary.summarize(
            self._setup.initial,
            self._setup.step,
            self._setup.settings,
            self._setup.delay,
            self._setup.theta_shapes,
            self._memory,
            self.n_learned,
            self._setup.estimated,
        )


def _chunks(n_samples: int, show: bool) -> Any:
    """First samples of the chunks of a record, with a progress bar on request."""
    steps = range(0, n_samples, _CHUNK)
    if not show:
        return steps
    from tqdm.auto import tqdm

    return tqdm(steps, desc="refining", unit="ksample")
