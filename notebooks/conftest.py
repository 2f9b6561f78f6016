"""Environment of the kernels in which nbmake runs the notebooks."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

#: Without it, doctest would import the percent scripts, which runs them.
collect_ignore_glob = ["*.py"]

KERNEL = {
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    # errors for the warnings that Python shows by default: a reader must not meet them
    "PYTHONWARNINGS": "error,ignore::DeprecationWarning,ignore::PendingDeprecationWarning,"
    "ignore::ImportWarning,ignore::ResourceWarning,error::DeprecationWarning:__main__",
    "RCOREFINE_PROGRESS": "0",
}


def pytest_itemcollected(item: pytest.Item) -> None:
    item.add_marker("notebook")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Start the kernel with the package of this folder, installed or not."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in KERNEL.items():
            patch.setenv(name, value)
        patch.setenv("PYTHONPATH", str(Path(__file__).resolve().parent.parent), prepend=os.pathsep)
        return (yield)
