"""Names in captures, recipes and results stay in their folder."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import write_photos
from PIL import Image

from refdgs_pipe import recipe
from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.datasets.readers import read_capture
from refdgs_pipe.errors import CaptureError, CorruptError, InputError
from refdgs_pipe.files.archive import check_zip
from refdgs_pipe.names import fault_of

OUT = (
    "../secret.png",
    "a/../../secret.png",
    "/etc/hostname",
    "a\0b.png",
    "C:/secret.png",
    "..\\x",
    "\ud800.png",
    "a" * 300,
)


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """A picture of the user's beside the capture."""
    path = tmp_path / "secret.png"
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path)
    return path


def data_set(folder: Path, name: str, **more: Any) -> Path:
    folder.mkdir()
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist(), **more}]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 50.0, "frames": frames}))
    return folder


@pytest.mark.parametrize("name", OUT)
def test_a_name_that_leads_out_of_its_folder_is_told(name: str) -> None:
    assert fault_of(name)


@pytest.mark.parametrize("name", ["a.png", "./train/r_0", "images/IMG 1.jpg", "..a/b..png"])
def test_a_name_below_its_folder_has_no_fault(name: str) -> None:
    assert fault_of(name) is None


@pytest.mark.parametrize("name", OUT)
def test_a_data_set_names_only_files_in_its_folder(tmp_path: Path, secret: Path, name: str) -> None:
    with pytest.raises(InputError, match="Files must lie in that folder"):
        Capture((data_set(tmp_path / "set", name),)).files()
    with pytest.raises(InputError, match="Files must lie in that folder"):
        Capture((data_set(tmp_path / "other", "a.png", mask_path=name),)).files()


def test_a_data_set_cannot_name_a_link_out_of_its_folder(tmp_path: Path, secret: Path) -> None:
    folder = data_set(tmp_path / "set", "photo.png")
    (folder / "photo.png").symlink_to(secret)
    with pytest.raises(InputError, match=r"photo.png.*is a link to .*secret.png"):
        Capture((folder,)).files()


def test_a_photo_that_is_a_link_out_of_the_folder_is_refused_by_name(
    tmp_path: Path, secret: Path
) -> None:
    write_photos(tmp_path / "photos")
    (tmp_path / "photos" / "inside.jpg").symlink_to("IMG_0.jpg")
    assert len(Capture((tmp_path / "photos",)).files()) == 4
    (tmp_path / "photos" / "outside.png").symlink_to(secret)
    with pytest.raises(CaptureError, match=r"outside.png is a link out of the folder"):
        Capture((tmp_path / "photos",)).files()


def test_a_mask_that_is_a_link_out_of_the_folder_is_refused(tmp_path: Path, secret: Path) -> None:
    write_photos(tmp_path / "photos")
    (tmp_path / "photos" / "masks").mkdir()
    (tmp_path / "photos" / "masks" / "IMG_0.png").symlink_to(secret)
    with pytest.raises(CaptureError, match="is a link out of the folder"):
        Capture((tmp_path / "photos",)).files()


def test_links_that_the_user_names_are_followed(tmp_path: Path) -> None:
    paths = write_photos(tmp_path / "photos")
    links = []
    for path in paths:
        links.append(tmp_path / f"link_{path.name}")
        links[-1].symlink_to(path)
    assert len(Capture(tuple(links)).files()) == 3
    (tmp_path / "folder").symlink_to(tmp_path / "photos")
    assert len(Capture((tmp_path / "folder",)).files()) == 3
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "images").symlink_to(tmp_path / "photos")
    assert len(Capture((tmp_path / "set",)).files()) == 3


def test_a_model_names_only_photos_that_are_there(tmp_path: Path, secret: Path) -> None:
    folder = tmp_path / "set"
    write_photos(folder / "images")
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (folder / "sparse" / "0" / "points3D.txt").write_text("")
    poses = "".join(
        f"{i} 1 0 0 0 0 0 0 1 {name}\n\n"
        for i, name in enumerate(("../secret.png", "../../secret.png", str(secret)))
    )
    (folder / "sparse" / "0" / "images.txt").write_text(poses)
    capture = Capture((folder,))
    assert not any(path == secret for _, path in capture.files())
    assert read_capture(capture.layout()).frames == []


@pytest.mark.parametrize("name", ["../evil.jpg", "/evil.jpg", "a/../../evil.jpg", "C:\\evil.jpg"])
def test_a_zip_names_only_what_lies_in_it(tmp_path: Path, name: str) -> None:
    path = tmp_path / "photos.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, b"x")
    with pytest.raises(CaptureError, match="Pack the folder again"):
        check_zip(path)


@pytest.mark.parametrize("name", ["../base.toml", "/etc/base.toml", "link.toml"])
def test_a_recipe_extends_only_files_in_its_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "base.toml").write_text("[train]\nseed = 1\n")
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "link.toml").symlink_to(tmp_path / "base.toml")
    own = tmp_path / "own" / "mine.toml"
    own.write_text(f"extends = '{name}'\n")
    with pytest.raises(InputError, match="in the same folder"):
        recipe.load(str(own))


@pytest.mark.parametrize("name", ["../../x", "a/b", "/x"])
@pytest.mark.parametrize("field", ["name", "file", "mask", "placing"])
def test_views_whose_names_lead_out_are_damaged(tmp_path: Path, field: str, name: str) -> None:
    if field != "name" and name == "a/b":
        return
    view = View("a", "images/a.png", 8, 8, "masks/a.png", "train", Exif(), 1.0, 0.5, None, "a.jpg")
    Views(tmp_path, (view,), "srgb", "photo").save(tmp_path)
    record = json.loads((tmp_path / "views.json").read_text())
    record["views"][0][field] = name
    (tmp_path / "views.json").write_text(json.dumps(record))
    with pytest.raises(CorruptError):
        Views.load(tmp_path)
