"""The page itself: who reaches it, and that a browser gets what there is."""

import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from viewing.light_browser import LightBrowser
from viewing.test_watching import work

from refdgs_pipe.errors import InputError
from refdgs_pipe.viewing.panel import Told, command, state_html, table_html
from refdgs_pipe.viewing.server import HOST, free_port
from refdgs_pipe.viewing.watching import Seen, Watch

PATIENCE_S, PICTURE = 60.0, "BackgroundImageMessage"
MIDDLE = np.array([0.0, 0.0, 1.0])  # of the object in `finished`
EYE, ELSEWHERE = np.array([3.0, 0.5, 2.0]), np.array([0.5, 3.0, 2.0])


@contextmanager
def served(root: Path) -> Iterator[int]:
    """A page of a workspace, with a thread that lets it work; its port."""
    pytest.importorskip("viser")
    from refdgs_pipe.cli.view import serve

    port, stop = free_port(), threading.Event()
    thread = threading.Thread(target=serve, args=(root, port, stop), kwargs={"cores": 2})
    thread.start()
    try:
        _until(lambda: _answers(port))
        yield port
    finally:
        stop.set()
        thread.join(PATIENCE_S)


def _answers(port: int) -> bool:
    with socket.socket() as tried:
        return tried.connect_ex((HOST, port)) == 0


def _until(is_so: object) -> None:
    assert callable(is_so)
    end = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a page that shows a finished workspace."""
    root = tmp_path_factory.mktemp("finished")
    work(root)
    with served(root) as port:
        yield port


def test_a_finished_workspace_is_served_on_this_machine_only(finished: int) -> None:
    page = urllib.request.urlopen(f"http://{HOST}:{finished}", timeout=PATIENCE_S)
    assert b"<html" in page.read()
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        place, number = line.split()[1].split(":")
        if int(number, 16) == finished:
            assert place == "0100007F"  # 127.0.0.1


@pytest.mark.parametrize(
    ("origin", "is_let_in"),
    [
        ("http://127.0.0.1:{port}", True),
        ("http://localhost:9000", True),
        ("https://example.com", False),
        ("http://127.0.0.1.example.com", False),
        ("null", False),
    ],
)
def test_only_pages_of_this_machine_may_connect(
    finished: int, origin: str, is_let_in: bool
) -> None:
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    where = f"ws://{HOST}:{finished}"
    options = {"origin": origin.format(port=finished)}
    protocols = [f"viser-v{viser.__version__}"]
    if is_let_in:
        with connect(where, subprotocols=protocols, **options) as connection:
            assert connection.recv(timeout=PATIENCE_S)
    else:
        with pytest.raises(InvalidStatus, match="403"):
            connect(where, subprotocols=protocols, **options)


def test_a_browser_gets_cameras_points_and_the_newest_of_the_object(finished: int) -> None:
    browser = LightBrowser(finished, look_at=MIDDLE, eye=EYE)
    kinds = ("CameraFrustumMessage", "PointCloudMessage", "GlbMessage")
    browser.until(*kinds, patience_s=PATIENCE_S)
    browser.close()
    frusta = [m for m in browser.messages if m["type"] == "CameraFrustumMessage"]
    assert len(frusta) == 5


def test_a_browser_gets_the_field_as_it_sees_it_and_again_only_if_it_moves(tmp_path: Path) -> None:
    work(tmp_path, until="refine")
    with served(tmp_path) as port:
        browser = LightBrowser(port, look_at=MIDDLE, eye=EYE)

        def count() -> int:
            return sum(message["type"] == PICTURE for message in browser.messages)

        browser.until(PICTURE, patience_s=PATIENCE_S)
        came = 0
        while came != (came := count()):  # a small one first, then a larger one
            assert came <= 3
            browser.listen(4.0)
        browser.messages.clear()
        browser.look(look_at=MIDDLE, eye=ELSEWHERE)
        browser.until(PICTURE, patience_s=PATIENCE_S)
        browser.close()


def test_a_workspace_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    root = tmp_path / "work"
    with served(root) as port:
        browser = LightBrowser(port, look_at=MIDDLE, eye=EYE)
        browser.listen(1.5)
        assert "CameraFrustumMessage" not in browser.kinds
        work(root, until="gate")
        browser.until("CameraFrustumMessage", patience_s=PATIENCE_S)
        browser.close()
    assert not (root / ".lock").exists()


def test_no_public_address_is_made() -> None:
    pytest.importorskip("viser")
    from refdgs_pipe.viewing.server import open_server, quiet

    server = open_server(free_port(), "a")
    try:
        assert server.request_share_url() is None
        assert server._share_tunnel is None
    finally:
        with quiet():
            server.stop()


def test_a_browser_that_comes_while_the_server_is_built_is_served(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    infra = pytest.importorskip("viser.infra")
    from refdgs_pipe.viewing.server import open_server, quiet

    port, came, start = free_port(), threading.Event(), infra.WebsockServer.start
    servers: list[Any] = []

    def slow(server: Any) -> None:
        start(server)
        assert came.wait(PATIENCE_S)
        time.sleep(0.5)  # viser has the connection by now

    with monkeypatch.context() as patched:
        patched.setattr(infra.WebsockServer, "start", slow)
        opening = threading.Thread(target=lambda: servers.append(open_server(port, "a")))
        opening.start()
        _until(lambda: _answers(port))
        browser = LightBrowser(port, look_at=MIDDLE, eye=EYE)
        came.set()
        opening.join(PATIENCE_S)
    try:
        browser.until("ThemeConfigurationMessage", patience_s=PATIENCE_S)
        browser.close()
    finally:
        with quiet():
            servers[0].stop()


def test_a_port_in_use_is_refused_and_another_one_found() -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port}: in use"):
            free_port(port)
        assert free_port() != port


def test_names_and_messages_cannot_become_html(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    html = state_html(Seen(), Told([evil], evil))
    assert "<script" not in html
    assert "&lt;script&gt;" in html
    assert "<script" not in table_html(Watch(tmp_path, [evil]).look(), {evil: evil})


def test_the_command_can_be_copied_into_a_shell() -> None:
    text = command("refdgs-pipe run a.refdgs", ["gate.up=[0, 0.1, 1]"])
    assert text == "refdgs-pipe run a.refdgs --set 'gate.up=[0, 0.1, 1]'"
