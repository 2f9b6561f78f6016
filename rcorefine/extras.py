"""Optional dependencies, imported when they are first needed.

An error names a dependency that is missing.
"""

from __future__ import annotations

import importlib
from typing import Any

from .exceptions import MissingExtraError


def needed(module: str, extra: str, what: str) -> Any:
    """A module that not everybody has.

    Parameters
    ----------
    module : str
        Name, as it is imported.
    extra : str
        Extra of this package that installs it.
    what : str
        What needs it.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f'{what} needs {module}; install the extra "{extra}": pip install "rcorefine[{extra}]"'
        ) from error
