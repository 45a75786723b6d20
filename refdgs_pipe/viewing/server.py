"""A viser server that only this machine reaches: on the loopback address, for pages of its own."""

import asyncio
import contextlib
import io
import re
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from typing import Any

from refdgs_pipe.errors import InputError

HOST = "127.0.0.1"
FIRST_PORT, PORTS = 8080, 100
# of pages that may connect: ours, also through a tunnel. Programs that are no browser send none
_ORIGINS = (None, re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?"))
_AGAIN_S = 0.02  # between two looks whether the server is built


def check_installed() -> None:
    """Say what to install where viser is missing.

    Raises:
        InputError: it is.
    """
    if find_spec("viser") is None or find_spec("websockets") is None:
        raise InputError(
            "the view needs viser: pip install 'refdgs-pipe[view]', or in a clone "
            "pip install -c constraints.txt '.[view]'"
        )


def free_port(wanted: int = 0) -> int:
    """A port of this machine that nothing listens on.

    Args:
        wanted: this one; 0: the first free one from 8080 on.

    Raises:
        InputError: the wanted one is in use or may not be used, or a hundred of them are.
    """
    for port in [wanted] if wanted else range(FIRST_PORT, FIRST_PORT + PORTS):
        with contextlib.suppress(OSError), socket.socket() as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind((HOST, port))
            return port
    if wanted:
        raise InputError(f"--port {wanted}: in use, or not allowed. Give another, or none")
    raise InputError(f"ports {FIRST_PORT} to {FIRST_PORT + PORTS - 1} are in use. Give --port")


def address(port: int) -> str:
    """Where a browser finds the view."""
    return f"http://{HOST}:{port}"


def open_server(port: int, title: str) -> Any:
    """Start a viser server. It prints nothing, and gives nothing to the internet.

    viser would offer a public address through a server of its makers: that is refused. It would
    also talk to the page of any website that is open in the same browser: such pages are refused
    by their origin (cross-site WebSocket hijacking, RFC 6455, 10.2). viser listens before it is
    completely built, and a browser that came then would be turned away: it waits instead.

    Returns:
        viser.ViserServer.
    """
    import viser
    import websockets.asyncio.server

    class Server(viser.ViserServer):  # type: ignore[misc]
        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    built = threading.Event()
    plain = websockets.asyncio.server.serve  # viser takes no origins

    def serve(handler: Callable[[Any], Awaitable[None]], *args: Any, **options: Any) -> Any:
        return plain(partial(_when_built, built, handler), *args, origins=_ORIGINS, **options)

    websockets.asyncio.server.serve = serve
    try:
        with quiet():
            server = Server(host=HOST, port=port, label=title, verbose=False)
    finally:
        websockets.asyncio.server.serve = plain
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
    built.set()
    return server


async def _when_built(
    built: threading.Event, handler: Callable[[Any], Awaitable[None]], connection: Any
) -> None:
    """Handle a connection as soon as the server is built."""
    while not built.is_set():
        await asyncio.sleep(_AGAIN_S)
    await handler(connection)


@contextmanager
def quiet() -> Iterator[None]:
    """Let nothing be printed on stdout: viser has words of its own."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
