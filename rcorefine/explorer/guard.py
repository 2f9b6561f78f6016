"""Who may open the served page, and what the page may do."""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence

from bokeh.server.auth_provider import NullAuth
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.web import HTTPError, OutputTransform, RequestHandler

__all__ = ["Policy", "Visitors"]


class Visitors(NullAuth):  # type: ignore[misc]
    """Access control that admits only visitors of the server's addresses.

    It acts before anything is built for the request.
    A page of another origin is refused, whether it fetches, embeds or loads this one as a picture; so is a
    name that leads here but is none of the server's (DNS rebinding), and a session that the address names.

    Parameters
    ----------
    hosts : sequence of str
        Names of the server, with its port.
    """

    login_url = "/"  # asked for where visitors are looked at

    def __init__(self, hosts: Sequence[str]) -> None:
        self._hosts = hosts
        super().__init__()

    async def get_user_async(self, asking: RequestHandler) -> str:
        """Return the name of a visitor who may enter.

        bokeh awaits it before it answers a request.
        """
        host, headers = asking.request.host, asking.request.headers
        origin, site = headers.get("Origin", f"http://{host}"), headers.get("Sec-Fetch-Site", "none")
        clicked = headers.get("Sec-Fetch-Mode") == "navigate" and headers.get("Sec-Fetch-User") == "?1"
        own = host in self._hosts and origin.removeprefix("http://") in self._hosts
        if not own or not (clicked or site in ("none", "same-origin")):
            raise HTTPError(403, reason="the page is not for other pages; open its own address")
        if any(name.startswith("bokeh-") for name in (*asking.request.arguments, *map(str.lower, headers))):
            raise HTTPError(403, reason="a session is not taken from a request; open the bare address")
        return "visitor"


class Policy(OutputTransform):
    """Content security policy of the pages.

    It tells the browser what a page may load and run: files of the server, and the scripts in the page.
    """

    def __init__(self, request: HTTPServerRequest) -> None:
        self._host = request.host

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Add the policy to the headers, and its nonce to the page's scripts."""
        nonce = secrets.token_urlsafe(16)
        if headers.get("Content-Type", "").startswith("text/html"):
            chunk = re.sub(rb"<script\b", f'<script nonce="{nonce}"'.encode(), chunk)
            headers["Content-Length"] = str(len(chunk))
        headers["Content-Security-Policy"] = (
            f"default-src 'none'; script-src 'self' blob: 'nonce-{nonce}'; style-src 'self' 'unsafe-inline'; "
            f"img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' ws://{self._host}; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        headers["X-Content-Type-Options"], headers["Referrer-Policy"] = "nosniff", "no-referrer"
        return status_code, headers, chunk
