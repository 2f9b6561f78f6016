"""`explore`: the page in a notebook, or served to this machine alone."""

from __future__ import annotations

import contextlib
import secrets
import socket
import time
import webbrowser
from typing import Any

from rcorefine import Measurement

from ..arguments import as_flag, as_whole
from ..exceptions import needed
from ..results import counted
from .exploration import Exploration
from .look import PAGE

_HOST = "127.0.0.1"
_PATIENCE = 5.0  # s that what is served has to end


def explore(model: Any, data: Measurement, *, horizon: float | None = None) -> Explorer:
    """Try effects by hand on an interactive page, and watch the error fall.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement
        Record in time.
    horizon : float, optional
        Length in s of the free runs, as in `refine`.

    Returns
    -------
    Explorer
        Shows itself in a Jupyter notebook; `show` opens it in the browser. Both raise `MissingExtraError`
        where Panel is not installed (extra ``explore``).

    Raises
    ------
    control.ControlArgument
        If model or data are something else.
    DivergenceError
        If the free run of the model leaves all bounds.

    Examples
    --------
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> data = rco.Measurement(np.sin(np.arange(300.0)), np.cos(np.arange(300.0)), dt=0.02)
    >>> page = rco.explore(model, data)
    >>> len(page.exploration.steps)
    1
    >>> page.show()  # doctest: +SKIP
    'http://127.0.0.1:40213/'
    """
    return Explorer(model, data, horizon)


class Explorer:
    """The interactive page of a model and a record; `explore` makes it.

    Attributes
    ----------
    exploration : Exploration
        State of the page in a notebook: its steps, effects, `refinement`, `script()`. Who opens the served
        page has one of their own.
    """

    def __init__(self, model: Any, data: Measurement, horizon: float | None = None) -> None:
        self._given = model, data, horizon
        self.exploration = self._new()
        self._shown: Any = None  # in a notebook
        self._served: Any = None

    def _new(self) -> Exploration:
        model, data, horizon = self._given
        return Exploration(model, data, horizon=horizon)

    def show(self, port: int = 0, *, browser: bool = True) -> str:
        """Serve the page on this machine only, with one state per visitor.

        It is served in the background until `close`, or until the process ends.

        Parameters
        ----------
        port : int
            Port; 0 for any that is free.
        browser : bool
            Whether to open the browser.

        Returns
        -------
        str
            Address of the page, at 127.0.0.1.

        Raises
        ------
        MissingExtraError
            If Panel is not installed.
        OSError
            If the port is taken.
        """
        as_flag(browser, "browser")
        port = as_whole(port, "port", least=0, most=65535)
        pn, port = needed("panel", "explore", "explore"), _free(port)
        from .page import ExplorerPage, Policy, Visitors

        def visit() -> Any:
            pn.config.raw_css = [PAGE]
            return ExplorerPage(self._new()).root

        self.close()
        hosts = [f"{_HOST}:{port}", f"localhost:{port}"]
        self._served = pn.serve(
            visit,
            address=_HOST,
            port=port,
            websocket_origin=hosts,
            auth_provider=Visitors(hosts),
            transforms=[Policy],
            sign_sessions=True,
            secret_key=secrets.token_urlsafe(),
            show=False,
            threaded=True,
            title="rcorefine explorer",
            verbose=False,
        )
        address = f"http://{_HOST}:{port}/"
        _wait_for(port)
        if browser:
            webbrowser.open(address)
        return address

    def close(self) -> None:
        """End the serving, if there is any."""
        if self._served is not None:
            self._served.stop()
            self._served.join(_PATIENCE)
            if self._served.is_alive():  # a task that does not take its end: the others have
                loop = self._served.asyncio_loop
                with contextlib.suppress(RuntimeError):  # it has ended since
                    loop.call_soon_threadsafe(loop.stop)
        self._served = None

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> Any:
        pn = needed("panel", "explore", "explore")
        from .page import ExplorerPage

        if self._shown is None:
            pn.extension(raw_css=[PAGE], inline=True)
            self._shown = ExplorerPage(self.exploration).root
        return self._shown._repr_mimebundle_(include, exclude)

    def __repr__(self) -> str:
        steps = counted(len(self.exploration.steps) - 1, "step")
        return f"<Explorer: {self.exploration.error:.3g} % error after {steps}; .show() opens the page>"


def _free(port: int) -> int:
    """The port, or one that is free for 0."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((_HOST, port))
        return int(probe.getsockname()[1])


def _wait_for(port: int) -> None:
    """Until the server, which begins in a thread of its own, answers."""
    for _ in range(200):
        with contextlib.suppress(OSError), socket.create_connection((_HOST, port), timeout=1.0):
            return
        time.sleep(0.05)
    raise OSError(f"the page at {_HOST}:{port} does not begin to answer")
