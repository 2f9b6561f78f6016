"""Result of `localize_damage`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Unpack

import control as ct

from ..arguments import as_text
from ..effects.effect import Effect
from ..effects.springs import Stiffness
from ..exceptions import ModelError
from ..inference.f_tests import FTest
from ..results import Options, Result, Row, picture, show
from ..systems.linear import Array, LinearModel


def overall(tests: Sequence[FTest]) -> float:
    """Smallest p-value, corrected for the number of tests."""
    # Bonferroni: the smallest p-value times the number of tests
    valid = [test.p_value for test in tests if test.dof]
    return min(1.0, min(valid, default=1.0) * len(valid))


@dataclass(frozen=True, slots=True)
class DamageRow(Row):
    """One place of the structure.

    Attributes
    ----------
    name : str
        Parameter (``"k2"``).
    kind, place : str
        What could change, and where (``"stiffness"``, ``"link2"``).
    nominal : float
        Value in the model, in `unit`; 0 where the model has none.
    unit : str
        Unit, "" where unknown.
    change, std : float
        Estimated change and its standard deviation, in `unit`; for a place that is
        not named, what it would come to beside the named ones.
    joint, joint_std : float
        The same with every place free.
    percent, percent_std : float
        `change` and `std` in percent of `nominal`, nan where that is 0. Losses are negative.
    p_value : float
        Probability of as large a change where there is none.
    limit : float
        Detection limit: smallest change, in `unit`, that this record would have shown
        with the probability `DamageMap.power`.
    limit_percent : float
        The same in percent of `nominal`.
    named : bool
        Whether the change is significant, with multiplicity allowed for, and needed.
    rivals : tuple of str
        Places (``"stiffness at link3"``) that explain the record about as well instead.
    """

    name: str
    kind: str
    place: str
    nominal: float
    unit: str
    # change: with the named ones only; joint: with all candidates free
    change: float
    std: float
    joint: float
    joint_std: float
    percent: float
    percent_std: float
    p_value: float
    # detection limit: smallest change found with probability `power`
    limit: float
    limit_percent: float
    named: bool
    rivals: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Kind and place."""
        return f"{self.kind} at {self.place}"

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % confidence interval of the change, in percent.

        It is in `unit` where the model has no value.
        """
        # 95 % of a normal distribution
        if self.nominal == 0:
            return self.change - 1.96 * self.std, self.change + 1.96 * self.std
        return self.percent - 1.96 * self.percent_std, self.percent + 1.96 * self.percent_std


@dataclass(frozen=True, slots=True)
class NuisanceRow(Row):
    """A number that was estimated along, without being damage.

    Attributes
    ----------
    name : str
        Name.
    value, std : float
        Estimate and standard deviation.
    unit : str
        Unit, "" where unknown.
    """

    name: str
    value: float
    std: float
    unit: str


@dataclass(frozen=True, slots=True)
class HypothesisRow(Row):
    """One hypothesized damage scenario, fitted.

    Attributes
    ----------
    name : str
        Name of the scenario.
    effects : tuple of Effect
        What it changes.
    changes, std : dict
        ``{label: change}`` and standard deviations, in the units of the coefficients.
    percent : dict
        ``{label: change in percent of the model's value}``, where it has one.
    fit : tuple of float
        Fit in percent, one per output.
    log_likelihood : float
        Of the whitened residual, up to a constant.
    bic : float
        Bayesian information criterion: small is good.
    probability : float
        Of this scenario among those given (equal odds before).
    """

    name: str
    effects: tuple[Effect, ...]
    changes: dict[str, float]
    std: dict[str, float]
    percent: dict[str, float]
    fit: tuple[float, ...]
    log_likelihood: float
    bic: float
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class DamageMap(Result):
    """Changed places of a structure, with sizes and detection limits.

    Attributes
    ----------
    name : str
        Name of the model.
    rows : tuple of DamageRow
        One per candidate, in the order of the structure.
    groups : tuple of tuple of str
        Places that this record sees only together.
    ranking : tuple of HypothesisRow
        The hypothesized scenarios, the most probable first; empty where none was given.
    nuisances : tuple of NuisanceRow
        Damping ratio, offsets and tolerated parameters that were estimated along.
    covariance : ndarray, shape (m, m)
        Covariance of the joint estimates.
    linear : LinearModel
        The model with the named changes.
    damping : str
        "links", "ratio" or "fixed".
    significance, power : float
        Of the tests, and of the detection limits.
    fit, rmse, initial_fit : ndarray, shape (n_y,)
        Of the free run with the named changes, and fit of the model as it was.
    residual_orders : tuple of int
        Autoregressive order of each output's residual (0: white).
    tests : tuple of FTest
        Tests of the residual, as in `Diagnosis.tests`; empty where a record is too short.
    n_samples, duration : float
        Samples per output, and seconds.
    success : bool
        Whether the estimate converged.
    message : str
        What happened, in words.
    """

    # rows of all candidates, and those that the data see only together
    name: str
    rows: tuple[DamageRow, ...]
    groups: tuple[tuple[str, ...], ...]
    ranking: tuple[HypothesisRow, ...]
    nuisances: tuple[NuisanceRow, ...]
    # covariance of the joint estimate, (m, m)
    covariance: Array
    linear: LinearModel
    damping: str
    significance: float
    power: float
    # fit, error and residual of the model with the named changes
    fit: Array
    rmse: Array
    initial_fit: Array
    residual_orders: tuple[int, ...]
    tests: tuple[FTest, ...]
    n_samples: int
    duration: float
    success: bool
    message: str

    @property
    def explained(self) -> bool:
        """Return whether the residual passes its tests.

        If it does, nothing but the named changes is missing.
        """
        return bool(self.tests) and overall(self.tests) >= self.significance

    @property
    def named(self) -> tuple[DamageRow, ...]:
        """Rows of the places that changed, the largest share first."""
        # by the size of the relative change
        found = [row for row in self.rows if row.named]
        return tuple(sorted(found, key=lambda row: -abs(row.percent if row.nominal else 0.0)))

    @property
    def system(self) -> ct.StateSpace:
        """The model with the named changes, as a `control.StateSpace`."""
        return self.linear.to_statespace()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The named changes as effects, to go on with in `refine` or `compare`."""
        # the estimates as starting values
        return tuple(Effect(row.kind, row.place, start={row.kind: row.change}) for row in self.named)

    def row(self, place: str, kind: str = Stiffness.name) -> DamageRow:
        """Row of one place.

        Parameters
        ----------
        place : str
            Place (``"link2"``) or name of the parameter (``"k2"``).
        kind : str
            What could change there.

        Returns
        -------
        DamageRow

        Raises
        ------
        ModelError
            If there is none.
        """
        # by kind and place, or by the name of the parameter
        as_text(place, "place")
        as_text(kind, "kind")
        for row in self.rows:
            if (row.place == place and row.kind == kind) or row.name == place:
                return row
        known = ", ".join(row.label for row in self.rows)
        raise ModelError(f"there is no {kind} at {place!r} among the candidates: {known}")

    @picture
    def plot(
        self,
        *,
        kind: str | None = None,
        **options: Unpack[Options],
    ) -> ct.ControlPlot:
        """Bar chart along the structure: changes, intervals and detection limits.

        Parameters
        ----------
        kind : str, optional
            "stiffness" or "damping" alone; by default one panel for each.
        ax : Axes or array of Axes, optional
            Where to draw; one per panel.
        label : str or sequence of str, optional
            Names of the places on the axis.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", kind=kind, **options)
