"""Numbers as sentences and tables have them."""

from __future__ import annotations

import control as ct
import numpy as np

__all__ = ["chance", "frequency_text"]


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
    >>> chance(0.01234), chance(0.0), chance(0.01234, "p")
    ('0.012', '< 1e-300', 'p = 0.012')
    """
    if p_value <= 0:
        return f"{symbol} < 1e-300".strip()
    return f"{symbol} = {p_value:.2g}" if symbol else f"{p_value:.2g}"


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
