"""Import path of a user's law, by which another process finds it."""

from __future__ import annotations

import inspect
import sys
from typing import Any

from ..exceptions import ModelError
from .effect import Effect
from .law import Law

__all__ = ["import_path", "law_here", "module_of"]


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


def law_here(path: str, label: str) -> Any:
    """Return the law that `import_path` named, from imported modules.

    A file decides which function is called, and with which values. Therefore nothing is imported for it, and
    only functions and laws that a module itself defines are returned: no lazy attribute, nothing that it
    imported, nothing of Python's library or of this package.

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
        If no imported module has it.
    """
    module, _, name = path.partition(":")
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = inspect.getattr_static(found, part, None)
        found = found.__func__ if isinstance(found, staticmethod) else found
    plain = inspect.getattr_static(found, "py_func", found)  # of what numba compiled
    ours = inspect.isfunction(plain) or (isinstance(plain, type) and issubclass(plain, Law))
    library = module.split(".")[0] in sys.stdlib_module_names | {__name__.split(".")[0]}
    if library or not ours or (plain.__module__, plain.__qualname__) != (module, name):
        raise ModelError(
            f"the law of {label!r} was saved as {path}, and loading a file imports nothing: pass "
            f"laws={{{label!r}: law}}, or import its module first if you trust it"
        )
    return found


def module_of(name: str) -> str:
    """Module that a dotted name begins with, "" where none is imported."""
    while name and name not in sys.modules:
        name = name.rpartition(".")[0]
    return name
