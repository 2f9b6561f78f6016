"""NumPy error settings of the package.

They apply whatever the user has set.
"""

from __future__ import annotations

import numpy as np


def own_arithmetic() -> np.errstate:
    """Return NumPy's default error settings as a context or decorator.

    A weight that underflows is zero, and raises no error.
    """
    return np.errstate(divide="warn", over="warn", invalid="warn", under="ignore")
