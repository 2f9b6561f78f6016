"""Doctests of the package: names that every example may use (not shipped)."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from typing import Any

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest

import rcorefine as rco

os.environ.setdefault("MPLBACKEND", "Agg")

#: modules that import Panel, where the extra explore is not installed
PAGE = [f"explorer/{name}.py" for name in ("figures", "page")]
collect_ignore = [] if importlib.util.find_spec("panel") else PAGE


@pytest.fixture(autouse=True)
def _doctest_names(doctest_namespace: dict[str, Any]) -> Iterator[None]:
    doctest_namespace.update(np=np, ct=ct, rco=rco)
    yield
    plt.close("all")
