"""Who may talk to the page: its own address only, and beyond this machine only with its token.

A browser sends what any page asks for to any address it can reach. Two headers that a page cannot
set tell whose page asks: ``Host``, the name that was looked up (a foreign name that points here is
DNS rebinding), and ``Origin``, the page. On loopback both must be this server's own. Beyond it the
name may be any address, so a secret word in the printed address lets in who was given it; a cookie
carries it on to the web socket.
"""

from __future__ import annotations

import contextlib
import hmac
import http
import http.cookies
import ipaddress
import secrets
import socket
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from gsfluent.errors import InputError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

Handler = Callable[["ServerConnection", "Request"], "Response | None"]

_COOKIE = "gsfluent_viewer"
_LOCAL = ("localhost", "127.0.0.1", "::1")


class Guard:
    """Decides about requests to a page that listens on ``host``.

    Attributes:
        token: What a request must bring, "" where the page cannot be reached from elsewhere.

    Args:
        host: Address that is listened on.
    """

    def __init__(self, host: str) -> None:
        self.local = is_loopback(host)
        self.token = "" if self.local else secrets.token_urlsafe(24)
        self._names = {*_LOCAL, host.strip("[]").lower()}
        if not self.local:
            name = socket.gethostname().lower()
            self._names |= {name, f"{name}.local", socket.getfqdn().lower()}
        self.installed = False

    def refusal(self, request: Request) -> str:
        """Why a request is refused; "" when it is not."""
        hosts = request.headers.get_all("Host")
        origins = request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_mine(hosts[0]):
            return "this is not the name of the page"
        if len(origins) > 1 or (origins and not _same(origins[0], hosts[0])):
            return "another page asks"
        if self.token and not hmac.compare_digest(self._given(request), self.token.encode()):
            return "the token is missing: open the address that gsfluent printed"
        return ""

    def _is_mine(self, host: str) -> bool:
        """Whether a ``Host`` header names this machine; an address cannot be looked up wrongly."""
        try:
            name = (urlsplit(f"//{host}").hostname or "").lower()
        except ValueError:
            return False
        if name in self._names:
            return True
        if self.local:
            return False
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name)
            return True
        return False

    def _given(self, request: Request) -> bytes:
        """The token of a request: in its address, or in the cookie that came with the page."""
        query = parse_qs(urlsplit(request.path).query).get("token", [])
        if query:
            return query[0].encode()
        try:
            cookies = http.cookies.SimpleCookie("; ".join(request.headers.get_all("Cookie")))
        except http.cookies.CookieError:
            return b""
        return cookies[_COOKIE].value.encode() if _COOKIE in cookies else b""

    def wrap(self, inner: Handler | None) -> Handler:
        """The handler of requests behind the guard."""
        self.installed = True

        def handle(connection: ServerConnection, request: Request) -> Response | None:
            why = self.refusal(request)
            if why:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"gsfluent: {why}\n")
            response = None if inner is None else inner(connection, request)
            if response is not None:
                response.headers["X-Frame-Options"] = "DENY"
                response.headers["Referrer-Policy"] = "no-referrer"
                if self.token:
                    response.headers["Set-Cookie"] = (
                        f"{_COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict"
                    )
            return response

        return handle


def is_loopback(host: str) -> bool:
    """Whether an address can be reached from this machine only."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _same(origin: str, host: str) -> bool:
    """Whether a page comes from the address that it asks; behind a tunnel both name its end."""
    parts = urlsplit(origin)
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()


@contextlib.contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Put the guard before every request of the server that is started in this block.

    viser has no setting for it; it calls ``websockets.asyncio.server.serve`` by this name.

    Raises:
        InputError: The server did not: nothing would stand guard.
    """
    import websockets.asyncio.server as server

    plain: Any = server.serve

    def serve(*given: Any, process_request: Handler | None = None, **named: Any) -> Any:
        return plain(*given, process_request=guard.wrap(process_request), **named)

    setattr(server, "serve", serve)  # noqa: B010 - a name of another package
    try:
        yield
    finally:
        setattr(server, "serve", plain)  # noqa: B010
    if not guard.installed:
        raise InputError(
            "view: this viser starts its server in another way than gsfluent guards",
            'pip install "gsfluent[viewer]" anew, or report the version of viser',
        )
