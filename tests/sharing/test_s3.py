"""Shared results over S3 as it is spoken: a server of moto's, in a process of its own."""

import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path

import pytest

from refdgs_pipe.errors import DiskFault, InputError
from refdgs_pipe.pipeline.manifest import Origin, Record
from refdgs_pipe.pipeline.shared import Sharing
from refdgs_pipe.pipeline.store import Store
from refdgs_pipe.sharing import places, upkeep
from refdgs_pipe.sharing.places import look_at, open_place

pytest.importorskip("obstore", reason="obstore is not installed: the extra batch")
if any(find_spec(name) is None for name in ("moto", "flask", "flask_cors", "boto3")):
    pytest.skip(
        "moto is not installed: pip install 'moto[s3]' flask flask-cors", allow_module_level=True
    )

ORIGIN = Origin("train", 1, {}, {"x": "y"})
BYTES = os.urandom(12 << 20)  # more than two parts of an upload


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    code = "from moto.server import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "-H", "127.0.0.1", "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
    )
    url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 60
        while True:
            try:
                request = urllib.request.Request(f"{url}/shop", method="PUT")
                urllib.request.urlopen(request, timeout=5).close()
                break
            except OSError:
                assert time.monotonic() < deadline and process.poll() is None
                time.sleep(0.1)
        yield url
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def place(server: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    monkeypatch.setenv("AWS_ENDPOINT_URL", server)
    monkeypatch.setenv("AWS_ALLOW_HTTP", "true")
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "id")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    return f"s3://shop/{request.node.name}"


def made(root: Path, data: bytes, place: str) -> Sharing:
    """Make a result in a workspace, and share it."""
    store, told = Store(root), list[str]()
    sharing = Sharing(open_place(place), store, lambda _, words: told.append(words))
    folder = store.partial(ORIGIN)
    (folder / "field").write_bytes(data)
    sharing.offer(store.commit(folder, ORIGIN, Record(1.0, {})))
    assert told == []
    return sharing


def test_a_result_comes_back_from_a_bucket_and_upkeep_works(tmp_path: Path, place: str) -> None:
    made(tmp_path / "farm", BYTES, place)
    store = Store(tmp_path / "laptop")
    sharing = Sharing(look_at(place), store, lambda _, words: pytest.fail(words))
    assert sharing.bring(ORIGIN) is not None
    assert (store.folder(ORIGIN) / "field").read_bytes() == BYTES
    objects = open_place(place)
    assert upkeep.verify(objects).files == 1
    assert upkeep.collect(objects, timedelta(0), lambda _: False).records == 1
    assert Sharing(objects, Store(tmp_path / "x"), lambda *_: None).bring(ORIGIN) is None


def test_of_sixteen_racing_writers_one_wins(tmp_path: Path, place: str) -> None:
    threads = [
        threading.Thread(target=made, args=(tmp_path / f"w{i}", b"%d" % i, place))
        for i in range(16)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    readers = [Sharing(open_place(place), Store(tmp_path / f"r{i}"), print) for i in range(3)]
    found = {manifest.digest for r in readers if (manifest := r.bring(ORIGIN))}
    assert len(found) == 1


def test_a_bucket_that_is_not_there_is_named_before_anything_runs(place: str) -> None:
    with pytest.raises((InputError, DiskFault), match="s3://nowhere"):
        look_at("s3://nowhere/x")


def test_a_server_that_is_not_there_is_a_fault_and_not_a_mistake(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setattr(places, "_RETRY", {"max_retries": 0})
    with pytest.raises(DiskFault, match="cannot be used"):
        look_at(place)
