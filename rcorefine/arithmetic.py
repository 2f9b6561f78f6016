"""NumPy's arithmetic as the package means it, whatever the user has set for his own."""

from __future__ import annotations

import numpy as np

__all__ = ["own_arithmetic"]


def own_arithmetic() -> np.errstate:
    """NumPy's defaults as a context or decorator: a weight that underflows is zero, and no error."""
    return np.errstate(divide="warn", over="warn", invalid="warn", under="ignore")
