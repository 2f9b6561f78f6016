"""Command `rcorefine explore`: serve the interactive page.

The page is served until it is interrupted.
"""

from __future__ import annotations

import sys
import threading
from argparse import Namespace

from ..explorer.serving import explore
from ..models.reading import read_model
from .records import read_record

__all__ = ["run_explore"]


def run_explore(arguments: Namespace) -> int:
    """Serve the page until Ctrl-C; 0."""
    model = read_model(arguments.model)
    data = read_record(arguments.data, model, arguments)
    page = explore(model, data, horizon=arguments.horizon)
    try:  # from the first thread on: one that serves would outlive this one
        address = page.show(arguments.port, browser=arguments.browser)
        sys.stdout.write(f"Explorer at {address} (Ctrl-C ends it)\n")
        sys.stdout.flush()
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        page.close()
    return 0
