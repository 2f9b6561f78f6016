"""Diagnosis and correction of linear models from measured data.

The package finds out why a linear model and a measured record disagree, and corrects the model.

The toolbox builds on python-control: `control.StateSpace` goes in and comes
out. The estimator is retrospective cost model refinement (D'Amato et al.).
"""

import ast as _ast
import importlib as _importlib
from pathlib import Path as _Path
from typing import Any as _Any

from .version import __version__ as __version__

# A name is imported when it is first asked for (as SPEC 1 of Scientific Python has it): what a session or a
# worker does not use costs it nothing. The stub beside says where each stands.
_FACE = {
    alias.asname or alias.name: (node.module, alias.name)
    for node in _ast.parse(_Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, _ast.ImportFrom)
    for alias in node.names
}
__all__ = sorted(name for name in _FACE if not name.startswith("_"))


def __getattr__(name: str) -> _Any:
    module, attribute = _FACE.get(name, (None, name))
    try:
        found = _importlib.import_module(f"{__name__}.{module or name}")
    except ModuleNotFoundError as error:
        if error.name != f"{__name__}.{name}":
            raise
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
    if module is not None:
        found = globals()[name] = getattr(found, attribute)
    return found


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
