"""The web server under the page: viser, on a port that is free."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from typing import TYPE_CHECKING

from gsfluent.errors import InputError, need
from gsfluent.viewer.guard import Guard, guarded

if TYPE_CHECKING:
    import viser

_log = logging.getLogger(__name__)
_TRIES = 50  # ports after the wanted one
_BRAND = (47, 111, 196)


def start_server(host: str, port: int, label: str, guard: Guard) -> viser.ViserServer:
    """Start serving behind a guard.

    Raises:
        InputError: viser is not installed, or host and port cannot be had.
    """
    viser = need("viser", "viewer", "view: the page")
    free, server = free_port(host, port), None
    if port not in (0, free):
        _log.warning("viewer: port %d is in use; taking %d", port, free)
    # viser greets on stdout, which belongs to --json
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            with guarded(guard):
                server = viser.ViserServer(host=host, port=free, label=label, verbose=False)
        except InputError:
            if server is not None:
                server.stop()
            raise
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, dark_mode=False, brand_color=_BRAND
    )
    server.scene.set_up_direction("+z")
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop serving, silently."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def free_port(host: str, port: int) -> int:
    """The first port from ``port`` on that can be bound; any when 0.

    Raises:
        InputError: No such address here, the port is not allowed, or all near it are taken.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}", "give a number from 0 (any) to 65535")
    for candidate in range(port, min(port + _TRIES, 65535) + 1):
        try:
            family = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0][0]
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, candidate))
                return int(probe.getsockname()[1])
        except (socket.gaierror, UnicodeError) as error:
            raise InputError(
                f"--host {host}: {error}", "give 127.0.0.1 (this machine) or 0.0.0.0 (everybody)"
            ) from error
        except PermissionError as error:
            raise InputError(
                f"--port {candidate}: {error.strerror}", "give a port of 1024 or more"
            ) from error
        except OSError as error:
            if error.errno is not None and _not_local(error.errno):
                raise InputError(
                    f"--host {host}: {error.strerror}",
                    "give 127.0.0.1 (this machine) or 0.0.0.0 (everybody)",
                ) from error
    raise InputError(
        f"--port {port}: it and the {_TRIES} after it are in use", "give another --port"
    )


def _not_local(number: int) -> bool:
    import errno

    return number in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT)
