"""Where a user's law comes from: the name that leads to it in another process."""

from __future__ import annotations

import importlib
import sys
from typing import Any

from ..exceptions import ModelError
from .effect import Effect

__all__ = ["import_path", "imported", "module_of"]


def import_path(effect: Effect) -> str:
    """Name of an effect's own law as ``"module:qualname"``.

    Parameters
    ----------
    effect : Effect
        Effect.

    Returns
    -------
    str
        Empty for laws of this package, and for a law that no name leads to (a lambda, what is
        defined inside a function).
    """
    own = type(effect.spec)
    inside = own.__module__.split(".")[0] == __name__.split(".")[0]
    law: Any = effect.law if effect.law is not None or inside else own
    module, name = getattr(law, "__module__", None), getattr(law, "__qualname__", None)
    if law is None or not module or not name:
        return ""
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return f"{module}:{name}" if found is law else ""


def imported(path: str, label: str) -> Any:
    """The law that `import_path` named.

    Parameters
    ----------
    path : str
        ``"module:qualname"``.
    label : str
        Effect, for messages.

    Returns
    -------
    callable or subclass of Law

    Raises
    ------
    ModelError
        If it cannot be imported.
    """
    module, _, name = path.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise ModelError(
            f"the law of {label!r} was saved as {path}, which cannot be imported here ({error}); put "
            f"its module on the path, or pass laws={{{label!r}: law}}"
        ) from error
    return found


def module_of(name: str) -> str:
    """Module that a dotted name begins with, "" where none is imported."""
    while name and name not in sys.modules:
        name = name.rpartition(".")[0]
    return name
