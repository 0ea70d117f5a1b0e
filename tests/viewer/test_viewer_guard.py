"""Hostile requests to the page: other names, other pages, no token."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

pytest.importorskip("viser", reason="the viewer's extra is not installed")

from gsfluent.errors import InputError
from gsfluent.viewer.guard import Guard, guarded, is_loopback
from gsfluent.viewer.server import start_server, stop_server

SOCKET = (
    "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol: viser-v1.1.1",
)  # fmt: skip


@pytest.fixture(scope="module", params=["127.0.0.1", "0.0.0.0"])
def page(request: pytest.FixtureRequest) -> Iterator[tuple[int, Guard]]:
    guard = Guard(request.param)
    server = start_server(request.param, 0, "test", guard)
    yield server.get_port(), guard
    stop_server(server)


def ask(port: int, *headers: str, path: str = "/") -> tuple[int, str]:
    """Status and headers of the answer to a request."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as line:
        text = "\r\n".join([f"GET {path} HTTP/1.1", *headers, "", ""])
        line.sendall(text.encode("latin-1"))
        answer = b""
        while b"\r\n\r\n" not in answer and (part := line.recv(4096)):
            answer += part
    head = answer.decode("latin-1").partition("\r\n\r\n")[0]
    return int(head.split()[1]), head


def own(port: int, guard: Guard) -> tuple[tuple[str, ...], str]:
    """Headers and path of a request that is in order."""
    return (f"Host: localhost:{port}",), f"/?token={guard.token}" if guard.token else "/"


def test_the_page_itself_is_let_in(page: tuple[int, Guard]) -> None:
    port, guard = page
    headers, path = own(port, guard)
    status, head = ask(port, *headers, path=path)
    assert status == 200 and "X-Frame-Options: DENY" in head
    status, _ = ask(port, *headers, f"Origin: http://localhost:{port}", *SOCKET, path=path)
    assert status == 101
    # through a tunnel the browser knows another port, for both
    through = ("Host: localhost:9999", "Origin: http://localhost:9999")
    assert ask(port, *through, *SOCKET, path=path)[0] == 101


@pytest.mark.parametrize(
    "headers",
    [
        ("Host: evil.example:{port}",),  # DNS rebinding
        ("Host: localhost.evil.example:{port}",),
        ("Host: localhost:{port}", "Host: localhost:{port}"),
        ("Host: localhost:{port}", "Origin: http://evil.example"),
        ("Host: localhost:{port}", "Origin: null"),
        ("Host: localhost:{port}", "Origin: http://localhost:1"),  # another page of this machine
        ("Host: localhost:{port}", "Origin: file://localhost:{port}"),
        ("Host: evil.example", "Origin: http://evil.example"),
        ("Host: [::1",),
        (),
    ],
)
@pytest.mark.parametrize("upgrade", [(), SOCKET], ids=["page", "socket"])
def test_others_are_refused(
    page: tuple[int, Guard], headers: tuple[str, ...], upgrade: tuple[str, ...]
) -> None:
    port, guard = page
    _, path = own(port, guard)
    assert ask(port, *(h.format(port=port) for h in headers), *upgrade, path=path)[0] in (400, 403)


def test_beyond_this_machine_the_token_is_needed_and_kept_in_a_cookie(
    page: tuple[int, Guard],
) -> None:
    port, guard = page
    host = f"Host: localhost:{port}"
    if guard.local:
        assert guard.token == "" and "Set-Cookie" not in ask(port, host)[1]
        return
    assert len(guard.token) >= 32 and guard.token != Guard("0.0.0.0").token
    for path in ("/", "/?token=", f"/?token={guard.token[:-1]}", "/assets/x.js"):
        assert ask(port, host, path=path)[0] == 403
        assert ask(port, host, *SOCKET, path=path)[0] == 403
    _, head = ask(port, host, path=f"/?token={guard.token}")
    cookie = next(x for x in head.splitlines() if x.startswith("Set-Cookie: ")).split(": ", 1)[1]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    given = f"Cookie: other=1; {cookie.split(';')[0]}"
    assert ask(port, host, given)[0] == 200
    assert ask(port, host, given, *SOCKET)[0] == 101
    assert ask(port, "Host: 192.168.1.5:8080", given)[0] == 200  # by its address
    assert ask(port, host, "Cookie: gsfluent_viewer=wrong")[0] == 403


def test_a_server_that_cannot_be_guarded_is_not_started() -> None:
    with pytest.raises(InputError, match="another way"), guarded(Guard("127.0.0.1")):
        pass


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("127.0.0.9", True), ("::1", True), ("LocalHost", True),
     ("0.0.0.0", False), ("::", False), ("192.168.1.5", False), ("box.example", False)],
)  # fmt: skip
def test_what_is_loopback(host: str, local: bool) -> None:
    assert is_loopback(host) == local
