"""The option --mask-model: refused early, known by content, and left out without a trace."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from refdgs_pipe.cli import mask_model
from refdgs_pipe.cli.app import app
from refdgs_pipe.cli.workspace import Workspace, is_workspace, open_for_run, open_workspace
from refdgs_pipe.errors import InputError
from refdgs_pipe.pipeline.store import Manifest, Origin, Record


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(b"\xff\xd8")
    return folder


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "net.onnx"
    path.write_bytes(b"one")
    return path


def opened(photos: Path, *assignments: str) -> Workspace:
    return open_for_run([photos], None, None, assignments)


def keyed(space: Workspace) -> dict[str, str]:
    (plain,) = space.settings["masks"].hashed()
    return plain


def test_the_option_sets_an_absolute_path_and_its_content_is_the_key(
    photos: Path, network: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(network.parent)
    said = mask_model.assignment("net.onnx")
    assert said == f"masks.model={json.dumps(str(network))}"
    first = keyed(opened(photos, said))
    moved = network.with_name("other.onnx")
    moved.write_bytes(b"one")
    assert keyed(opened(photos, mask_model.assignment("other.onnx"))) == first
    network.write_bytes(b"two")
    assert keyed(opened(photos, said))["model"] != first["model"]
    without = mask_model.assignment("")
    assert keyed(opened(photos, said, without)) == keyed(opened(photos))


def test_a_wrong_file_is_refused_before_anything_is_made(photos: Path, tmp_path: Path) -> None:
    for arguments, words in (
        (["--mask-model", str(tmp_path / "gone.onnx")], "gone.onnx: no such file"),
        (["--set", f"masks.model={tmp_path}/gone.onnx"], "gone.onnx: no such file"),
        (["--set", "masks.model=net.onnx"], "expected an absolute path"),
        (["--mask-model", str(photos)], "no such file"),
    ):
        result = CliRunner().invoke(app, ["run", str(photos), "--dry-run", *arguments])
        assert isinstance(result.exception, InputError) and words in str(result.exception)
        assert result.exception.exit_code == 64
    assert not (tmp_path / "photos.refdgs").exists()


def test_what_is_no_network_ends_a_run_before_its_first_stage(
    photos: Path, network: Path, tmp_path: Path
) -> None:
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    result = CliRunner().invoke(app, ["run", str(photos), "--mask-model", str(network), "-q"])
    assert isinstance(result.exception, InputError)
    assert "not an ONNX model" in str(result.exception)
    work = tmp_path / "photos.refdgs"
    assert not (work / "ingest").exists() and not is_workspace(work)


def made_by(space: Workspace, name: str) -> Manifest:
    """A result of the stage `masks`, by a network of that name."""
    (params,) = space.settings["masks"].hashed()
    store, origin = space.pipeline.store, Origin("masks", 1, params, {})
    record = Record(1.0, {}, (("network", name, ""),))
    manifest = store.commit(store.partial(origin), origin, record)
    store.use(origin)
    return manifest


def test_a_file_that_is_gone_counts_as_it_was(photos: Path, network: Path) -> None:
    said = mask_model.assignment(str(network))
    space = opened(photos, said)
    space.root.mkdir()
    space.memory.write(space.root)
    before = keyed(space)
    network.unlink()
    with pytest.raises(InputError, match="no such file"):
        open_workspace(space.root)
    made_by(space, "another.onnx")
    with pytest.raises(InputError, match="no such file"):
        open_workspace(space.root)
    made_by(space, "net.onnx")
    assert keyed(open_workspace(space.root)) == before


def test_status_names_the_network_that_changed(photos: Path, network: Path) -> None:
    from refdgs_pipe.pipeline.reasons import why

    said = mask_model.assignment(str(network))
    space = opened(photos, said)
    space.root.mkdir()
    last = made_by(space, "net.onnx")
    network.write_bytes(b"two")
    now = Origin("masks", 1, keyed(opened(photos, said)), {})
    assert why(now, last, makers={}, source_files={}).startswith("model ")
