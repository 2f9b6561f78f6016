"""Doctests of the package: names that every example may use (not shipped)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest

import rcorefine as rco

os.environ.setdefault("MPLBACKEND", "Agg")


@pytest.fixture(autouse=True)
def _doctest_names(doctest_namespace: dict[str, Any]) -> Iterator[None]:
    doctest_namespace.update(np=np, ct=ct, rco=rco)
    yield
    plt.close("all")
