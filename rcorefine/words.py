"""Numbers as sentences and tables have them."""

from __future__ import annotations

import math

import control as ct
import numpy as np

_SURE = 0.995  # where two digits would make it a certainty
_MOST = 6  # significant digits of an estimate, however well it is known


def chance(p_value: float, symbol: str = "") -> str:
    """A p-value with two digits; what is smaller than any number is not zero.

    Parameters
    ----------
    p_value : float
        Probability.
    symbol : str
        What it is called in a sentence; none in a table.

    Returns
    -------
    str

    Examples
    --------
    >>> chance(0.01234), chance(0.0), chance(0.01234, "p"), chance(0.9998, "p")
    ('0.012', '< 1e-300', 'p = 0.012', 'p > 0.99')
    """
    if p_value <= 0:
        return f"{symbol} < 1e-300".strip()
    if p_value >= _SURE:
        return f"{symbol} > 0.99".strip()
    return f"{symbol} = {p_value:.2g}" if symbol else f"{p_value:.2g}"


def counted(number: int, what: str, several: str = "") -> str:
    """A number of things, in the singular where it is one.

    Parameters
    ----------
    number : int
        How many.
    what : str
        One of them.
    several : str
        More of them, where an s behind it will not do.

    Returns
    -------
    str

    Examples
    --------
    >>> counted(1, "step"), counted(3, "step"), counted(0, "frequency", "frequencies")
    ('1 step', '3 steps', '0 frequencies')
    """
    return f"{number} {what if number == 1 else several or what + 's'}"


def frequency_text(*omega: float) -> str:
    """Frequencies, given in rad/s, in the unit of python-control's plots.

    Parameters
    ----------
    *omega : float
        One, or several, which are listed.

    Returns
    -------
    str
        In Hz where ``control.config.defaults["freqplot.Hz"]`` says so, else in rad/s.

    Examples
    --------
    >>> frequency_text(6.2832)
    '6.283 rad/s'
    >>> import control as ct
    >>> ct.config.defaults["freqplot.Hz"] = True
    >>> frequency_text(6.2832, 12.566)
    '1, 2 Hz'
    >>> ct.config.defaults["freqplot.Hz"] = False
    """
    size, unit = (2 * np.pi, "Hz") if ct.config.defaults["freqplot.Hz"] else (1.0, "rad/s")
    return f"{', '.join(f'{one / size:.4g}' for one in omega)} {unit}"


def phase_text(angle: float) -> str:
    """A phase, given in rad, in whole degrees and without a sign.

    Parameters
    ----------
    angle : float
        Of the response over what it is compared with.

    Returns
    -------
    str

    Examples
    --------
    >>> phase_text(-2.1), phase_text(0.35)
    ('120 deg behind', '20 deg ahead of')
    """
    return f"{abs(math.degrees(angle)):.0f} deg {'behind' if angle < 0 else 'ahead of'}"


def estimate(value: float, std: float) -> tuple[str, str]:
    """Return a value and its standard deviation as rounded text.

    The standard deviation has two digits; the value is rounded to match it.

    Parameters
    ----------
    value, std : float
        What was estimated, and how well; four digits where that is not known.

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> estimate(0.00028725, 0.00048), estimate(29.9942, 1.0), estimate(203517.0, 1234.0)
    (('0.00029', '0.00048'), ('30.0', '1.0'), ('203500', '1200'))
    >>> estimate(-43.2123, float("inf"))
    ('-43.21', 'inf')
    """
    if not (math.isfinite(value) and math.isfinite(std) and std > 0):
        return f"{value:.4g}", f"{std:.2g}"
    last = math.floor(math.log10(float(f"{std:.1e}"))) - 1  # decimal place of its second digit
    if value:
        last = max(last, math.floor(math.log10(abs(value))) + 1 - _MOST)
    return _to(value, last), _to(float(f"{std:.1e}"), math.floor(math.log10(std)) - 1)


def with_error(value: float, std: float, unit: str = "") -> str:
    """An estimate with its standard deviation, as a sentence has it.

    Parameters
    ----------
    value, std : float
        As for `estimate`.
    unit : str
        Behind them.

    Returns
    -------
    str

    Examples
    --------
    >>> with_error(0.24961, 0.0003, "N")
    '0.24961 +/- 0.00030 N'
    """
    return f"{' +/- '.join(estimate(value, std))} {unit}".rstrip()


def _to(value: float, last: int) -> str:
    """Return a value rounded to the power of ten `last`, as text.

    Only very small and very large values have an exponent.
    """
    rounded = float(f"{value:.{max(_place(value) - last, 0)}e}") if value and _place(value) >= last else 0.0
    if not rounded:
        return f"{0.0:.{min(max(-last, 0), _MOST)}f}"
    if 1e-4 <= abs(rounded) < 1e7:
        return f"{rounded:.{max(-last, 0)}f}"
    return f"{rounded:.{_place(rounded) - last}e}"


def _place(value: float) -> int:
    return math.floor(math.log10(abs(value)))
