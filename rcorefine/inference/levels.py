"""Thresholds of all decisions.

Each level is documented with its statistic, the value of that by chance, and the consequence.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import control as ct

#: Levels of the comparisons that one table of hypotheses has replaced.
_GONE = frozenset({
    "same_force", "departs", "force", "force_beside", "hopeless", "color", "color_left",
    "hold", "hold_alike", "swap",
})  # fmt: skip


@dataclass(frozen=True, slots=True)
class Levels:
    """Levels at which tests and likelihoods decide.

    Each may be changed for a session: ``control.config.defaults["rcorefine.rival"] = 6.0``.
    The level of the tests themselves is the argument `significance` of `diagnose` and `improve`.

    Attributes
    ----------
    noise_excess : float
        Residual over the declared noise, 1 by chance. Beyond it no color of the noise excuses
        the residual: the model is not adequate.
    rival : float
        Twice the log of the odds of two hypotheses, or of a force of no law over the best one. Within it they
        are tied; 9.2 are odds of 100 to 1.
    named : float
        Probability from which on a set of effects is named alone.
    family : float
        Log of the odds within which the simpler one of a law and one that contains it is named: where the
        simpler one is true, the other one is further ahead in one record of several hundred.
    disagree : float
        p-value of Wald's test that two amplitudes ask for the same coefficients, uniform by
        chance. Below it the law only mimics the true one: unexplained.
    same_value : float
        Standard deviation, as a share of a coefficient, that this test allows beside the errors of the fits:
        that of kinks within a step, of a clock or a gain that differs from record to record.
    off : float
        Relative standard deviation of parameters that are hardly off: the least prior under which they are
        reported.
    power : float
        Standard deviations, normal by chance, that an effect must have beyond the test's own
        level to be promised as visible; 1.645 are 95 %.
    force_size : float
        Log-likelihood within which another size of that force is as good.
    colored_fit : float
        Fit of the free run in percent, 100 without noise. Below it a residual that passes as noise with
        a memory may be the error of the model: candidates and numbers are asked all the same.
    colored_size : float
        Standard deviation of such a residual over that of its innovations, 1 for white noise. Above it
        likewise.
    drowned : float
        Fit of the free run in percent, 100 without noise. Below it such a residual is more than noise may be:
        unexplained, where no set of effects explains it.
    zero : float
        Mean of an output over its standard deviation, about 0 by chance. Above it offsets are open wherever a
        law could want them.
    line : float
        Power at one frequency over the mean of its neighbors, about 1 by chance and rarely above 10. Above
        it the residual may hold a line...
    line_share : float
        ... if the line is a larger share of its power than this...
    line_drift : float
        ... and none of eight parts of the record departs from the whole by more than this share: noise
        at a resonance wanders.
    no_law : float
        Probability that none of the laws is the true one. Above it the answer says so.
    moved : float
        Standard deviations, normal by chance, from which on a parameter has moved. The size of an effect, and
        each coefficient that shapes it, must be as many from zero: else the effect is neither named nor kept.
    moved_far : float
        Share of a number. One that moved further, for certain, may stand in for a law.
    moved_wide : float
        Declared tolerances. A monitor whose numbers moved further does not call its model adequate.
    earned : float
        Log of the error on the choosing part, about 0 by chance, that each coefficient must
        save to be added by `improve`.
    matters : float
        Share of the spread of an output. A smaller error of the model does not matter, even if a test finds
        it, nor does one below the rounding step of the sensor.
    spoiled : float
        The same that a set chosen for its likelihood may cost there; and the share by which a set that is
        named may raise the error of the free run.
    failure : float
        p-value of a row of the failure map among all that were tried, uniform by chance. Below it
        the model fails there.
    failure_besides : float
        Share of the error's energy that a failure must explain to stand besides the first one.
    alarm_place : float
        Share of one place in the probability of all candidates. Above it, twice in a row, an alarm
        names it...
    alarm_left : float
        ... if the mean square of what the name leaves, 1 by chance, is below this. Above it (over that of the
        name before) a later look does not change the name.
    alarm_worth : float
        Log-likelihood that a name must earn over no change; below it an alarm may end.
    alarm_gone : float
        Standard deviations within which the coefficient of an alarm counts as zero...
    alarm_missed : float
        ... where the value that it had is more of them than this.
    collinear : float
        Smallest eigenvalue of the information about changes in units of their own, 1 where they
        are seen apart. Below it those in its direction are seen only together...
    blurred : float
        ... if the standard deviation of each, beside all others, is a larger share of the
        model's value than this.
    turned_over : float
        Residual with the sign of an output turned over, over that without, about 1 by chance where
        the sign does not matter. Below it the sign of the record is called wrong.
    aliased : float
        Share of an output's power from modes above half the sampling frequency. Above it an
        estimate is not called a success.
    """

    # residual tests and comparison of hypotheses
    noise_excess: float = 1.2
    rival: float = 9.2
    named: float = 0.95
    family: float = 2.3
    disagree: float = 0.005
    same_value: float = 0.005
    off: float = 0.05
    # significance of coefficients
    power: float = 1.645
    force_size: float = 6.0
    # noise, offsets and lines in the residual
    colored_fit: float = 75.0
    colored_size: float = 3.0
    drowned: float = 50.0
    zero: float = 0.1
    line: float = 30.0
    line_share: float = 0.2
    line_drift: float = 0.2
    # decision of a diagnosis: parameters or effects
    no_law: float = 0.05
    moved: float = 3.0
    moved_far: float = 0.3
    moved_wide: float = 2.0
    # stepwise improvement on validation data
    earned: float = 0.05
    matters: float = 0.01
    spoiled: float = 0.02
    # failure map
    failure: float = 0.01
    failure_besides: float = 0.005
    # alarms of a monitor
    alarm_place: float = 0.99
    alarm_left: float = 1.5
    alarm_worth: float = 12.0
    alarm_gone: float = 3.0
    alarm_missed: float = 6.0
    # changes that the data cannot distinguish
    collinear: float = 0.01
    blurred: float = 0.05
    # checks of a fit
    turned_over: float = 0.5
    aliased: float = 0.01


def levels() -> Levels:
    """Return the levels in force.

    They are the defaults, unless ``control.config`` sets other values.

    Returns
    -------
    Levels

    Raises
    ------
    ControlArgument
        If ``control.config`` holds a level that there is none of, or that is not positive (nor the default).

    Examples
    --------
    >>> import control as ct
    >>> from rcorefine.inference.levels import levels
    >>> levels().rival
    9.2
    >>> ct.config.defaults["rcorefine.rival"] = 6.0
    >>> levels().rival
    6.0
    >>> del ct.config.defaults["rcorefine.rival"]
    """
    prefix = "rcorefine."
    # only keys of this package
    given = {k.removeprefix(prefix): v for k, v in ct.config.defaults.items() if k.startswith(prefix)}
    known = {field.name: field.default for field in fields(Levels)}
    for name, value in given.items():
        if name in _GONE:
            raise ct.ControlArgument(
                f"rcorefine.{name} in control.config decides nothing any more; remove it"
            )
        if name not in known:
            raise ct.ControlArgument(f"control.config holds rcorefine.{name}; there is {', '.join(known)}")
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not (value > 0 or value == known[name]):
            raise ct.ControlArgument(
                f"rcorefine.{name} in control.config is {value!r}; give a positive number"
            )
    return Levels(**given)
