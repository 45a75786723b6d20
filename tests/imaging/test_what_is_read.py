"""HEIC, AVIF, TIFF, films, ZIPs, sub-folders, odd names and odd pictures: read, or said why not."""

import errno
import json
import os
import shutil
import stat
import struct
import zipfile
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from captures import SHARED, Stages, disc, needs_shared, picture, write_photos
from PIL import Image

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.views import Exif
from refdgs_pipe.errors import CaptureError, DiskFault, OutOfMemory
from refdgs_pipe.files import archive, heif
from refdgs_pipe.files.images import read_photo, read_png
from refdgs_pipe.files.kinds import sniff
from refdgs_pipe.imaging.films import choose, motion, refuse_hdr, take_frames
from refdgs_pipe.imaging.metadata import held_against, read_exif
from refdgs_pipe.imaging.raw import is_raw
from refdgs_pipe.pipeline.fingerprint import fingerprint

HEIC = Path(__file__).parents[1] / "data" / "heic"
ROTATIONS = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


@pytest.fixture
def stages(tmp_path: Path) -> Stages:
    return Stages(tmp_path / "workspace")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


def test_heic_is_read_upright_once_with_its_exif(stages: Stages, photos: Path) -> None:
    """Made with pillow-heif: turned.heic is stored lying, with an `irot` box and EXIF."""
    for name in ("plain", "turned", "third"):
        shutil.copyfile(HEIC / f"{name}.heic", photos / f"{name}.heic")
    views = stages.ingest(photos)
    seeds = {"plain": 0, "turned": 1, "third": 2}
    assert {view.name for view in views.items} == set(seeds)
    for view in views.items:
        assert view.width in (96, 128)
    plain = views["plain"]
    expected = picture(0, 96, 128).astype(int)
    assert np.abs(read_png(views.image_path(plain)) - expected).mean() < 5
    turned = read_png(views.image_path(views["turned"]))
    lying = np.rot90(picture(1, 96, 128)).astype(int)  # as it was encoded
    assert turned.shape == (96, 128, 3)
    assert np.abs(turned - np.rot90(lying, -1)).mean() < 5
    assert (plain.exif.model, plain.exif.focal_35mm, plain.exif.flash) == ("Phone", 26.0, True)


def test_a_crash_in_the_heic_decoder_is_a_skipped_photo(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copyfile(HEIC / "plain.heic", photos / "a.heic")
    real = heif.call_in_child
    monkeypatch.setattr(
        heif, "call_in_child", lambda target, arguments, **more: real("os:abort", {}, **more)
    )
    with pytest.raises(CaptureError, match=r"a\.heic: the HEIC decoder .*Export it as JPEG"):
        read_photo(photos / "a.heic")


def test_a_cut_heic_says_that_it_is_damaged(photos: Path) -> None:
    data = (HEIC / "plain.heic").read_bytes()
    (photos / "a.heic").write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(CaptureError, match=r"a\.heic: damaged heic"):
        read_photo(photos / "a.heic")


def test_the_users_own_heif_library_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    assert heif._library().__name__ == "pi_heif"
    own = ModuleType("pillow_heif")
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", own)
    assert heif._library() is own


def test_avif_is_read(photos: Path) -> None:
    Image.fromarray(picture(0, 96, 128)).save(photos / "a.avif", quality=90)
    assert sniff(photos / "a.avif") == "avif"
    assert np.abs(read_photo(photos / "a.avif").astype(int) - picture(0, 96, 128)).mean() < 4


def test_a_plain_16_bit_tiff_is_no_camera_raw(stages: Stages, photos: Path) -> None:
    """LibRaw opens such files, and makes them pale."""
    for i in range(3):
        wide = picture(i, 96, 128).astype(np.uint16) * 257
        cv2.imwrite(str(photos / f"{i}.tif"), wide[..., ::-1])
        assert not is_raw(photos / f"{i}.tif")
    views = stages.ingest(photos)
    assert views.color_space == "srgb"
    for i, view in enumerate(views.items):
        levels = read_png(views.image_path(view)) // 257
        np.testing.assert_array_equal(levels, picture(i, 96, 128))


@needs_shared
def test_a_dng_called_tif_and_an_old_kdc_are_camera_raw(photos: Path) -> None:
    shutil.copyfile(SHARED / "kettle_capture" / "dng" / "IMG_0000.dng", photos / "a.tif")
    assert is_raw(photos / "a.tif")
    assert is_raw(SHARED / "photos" / "kodak_dc50.kdc")


@pytest.mark.slow
def test_a_photo_of_200_megapixels_is_read_in_bounded_memory(tmp_path: Path) -> None:
    """16384 x 12288; measured in a process of its own: less than one decoded copy (604 MB)."""
    import subprocess
    import sys

    path = tmp_path / "huge.jpg"
    small = Image.fromarray(picture(0, 768, 1024))
    Image.MAX_IMAGE_PIXELS = None
    small.resize((16384, 12288), Image.Resampling.BILINEAR).save(path, quality=80)
    code = (
        "import resource, sys; from pathlib import Path\n"
        "from refdgs_pipe.files.images import read_photo\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "shape = read_photo(Path(sys.argv[1]), side=1600).shape\n"
        "print(*shape[:2], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
    )
    height, width, kilobytes = map(int, done.stdout.split())
    assert (width, height) == (4096, 3072)
    assert kilobytes < 604_000


def film(path: Path, *, rotation: int = 0, frames: int = 40) -> None:
    """A picture that slides to the left, in MPEG-4 with the rotation in its `tkhd` box."""
    wide = picture(7, 96, 128 + 4 * frames) // 2
    wide += np.random.default_rng(0).integers(0, 120, wide.shape, np.uint8)  # detail to blur
    cv2.rectangle(wide, (0, 0), (40, 20), (255, 0, 0), -1)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10, (128, 96))
    for i in range(frames):
        frame = np.ascontiguousarray(wide[:, 4 * i : 4 * i + 128, ::-1])
        writer.write(cv2.GaussianBlur(frame, (0, 0), 4) if i % 5 else frame)
    writer.release()
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 44  # version 0: the matrix
    a, b, c, d = (value * 65536 for value in ROTATIONS[rotation])
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_films_are_turned_upright(tmp_path: Path, rotation: int) -> None:
    """The red corner of the first frame goes round clockwise with the rotation."""
    film(tmp_path / "a.mov", rotation=rotation)
    taken = take_frames(tmp_path / "a.mov", tmp_path / "out", count=8, side=1600)
    first = read_png(taken[0][1])
    assert first.shape == ((96, 128, 3) if rotation in (0, 180) else (128, 96, 3))
    corners = [first[:12, :12], first[:12, -12:], first[-12:, -12:], first[-12:, :12]]
    red = [float(c[..., 0].mean() - c[..., 1:].mean()) for c in corners]
    assert int(np.argmax(red)) == rotation // 90


def test_a_film_becomes_its_sharpest_frames(stages: Stages, tmp_path: Path) -> None:
    """Every fifth frame is sharp; each stretch of equal motion has one."""
    film(tmp_path / "VID_0001.mp4")
    views = stages.ingest(tmp_path / "VID_0001.mp4", video_frames=5)
    numbers = [int(view.name.removeprefix("VID_0001_f")) for view in views.items]
    assert 4 <= len(numbers) <= 5 and numbers == sorted(numbers)
    assert all(number % 5 == 0 for number in numbers)
    assert views.items[0].source == f"VID_0001_f{numbers[0]:05d}.mp4"
    assert [name for name, _ in Capture((tmp_path / "VID_0001.mp4",)).files()] == ["VID_0001.mp4"]


def test_stretches_have_equal_motion_whatever_the_time() -> None:
    moved = np.array([0.0] * 50 + [1.0] * 10)
    sharp = np.arange(60.0)
    assert len(choose(moved, sharp, 5)) == 5
    assert sum(i >= 50 for i in choose(moved, sharp, 5)) >= 4
    assert choose(np.zeros(10), np.ones(10), 5) == [0, 2, 4, 6, 8]


def test_motion_is_a_share_of_the_long_side() -> None:
    gray = np.ascontiguousarray(picture(3, 240, 340)[..., 1])
    texture = np.random.default_rng(0).integers(0, 60, gray.shape).astype(np.uint8)
    gray = cv2.GaussianBlur(gray // 2 + texture, (0, 0), 1.5)
    assert motion(gray[:, :320].copy(), gray[:, 8:328].copy()) == pytest.approx(8 / 320, rel=0.1)


@pytest.mark.parametrize(("transfer", "word"), [(16, "smpte2084"), (18, "arib-std-b67")])
def test_hdr_films_are_refused_with_the_command_that_converts_them(
    stages: Stages, photos: Path, transfer: int, word: str
) -> None:
    film(photos / "IMG 1.mov")
    data = (photos / "IMG 1.mov").read_bytes()
    at = data.find(b"moov") - 4
    size = struct.unpack(">I", data[at : at + 4])[0]
    color = struct.pack(">I8sHHHB", 19, b"colrnclx", 9, transfer, 9, 0)
    moov = struct.pack(">I", size + len(color)) + data[at + 4 : at + size] + color
    (photos / "IMG 1.mov").write_bytes(data[:at] + moov + data[at + size :])
    with pytest.raises(CaptureError, match=rf"{word}.*ffmpeg -i 'IMG 1.mov' .*'IMG 1_sdr.mp4'"):
        refuse_hdr(photos / "IMG 1.mov")
    with pytest.raises(CaptureError, match="ffmpeg"):
        stages.ingest(photos)


def test_the_film_of_a_live_photo_is_left_alone(stages: Stages, photos: Path) -> None:
    write_photos(photos)
    film(photos / "IMG_1.mov")
    (photos / "broken.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    views = stages.ingest(photos)
    assert len(views.items) == 3
    (warning,) = stages.warnings
    assert "broken.mp4: the video cannot be opened" in warning


def test_sub_folders_are_read_in_natural_order(stages: Stages, photos: Path) -> None:
    places = ("IMG_1.jpg", "day 2/IMG_1.jpg", "day 10/IMG_1.jpg", "day 10/more/IMG_2.jpg")
    for i, name in enumerate(places):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture(i)).save(photos / name)
    for own in ("masks/IMG_1.png", "old.refdgs/asset/preview.png", "out/x.png", ".trash/a.jpg"):
        (photos / own).parent.mkdir(parents=True)
        Image.fromarray(disc()).save(photos / own)
    (photos / "out" / "workspace.json").write_text("{}")
    views = stages.ingest(photos)
    assert {view.source for view in views.items} == set(places)
    order = [view.source for view in views.items]
    assert order.index("day 2/IMG_1.jpg") < order.index("day 10/IMG_1.jpg")
    assert len({view.name for view in views.items}) == 4


def pack(path: Path, folder: Path, top: str = "") -> Path:
    with zipfile.ZipFile(path, "w") as out:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                out.write(file, f"{top}{file.relative_to(folder)}")
    return path


def test_a_zip_is_read_like_its_folder(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 4)
    (tmp_path / "photos" / "masks").mkdir()
    for i in range(4):
        Image.fromarray(disc()).save(tmp_path / "photos" / "masks" / f"IMG_{i}.png")
    path = pack(tmp_path / "a.zip", tmp_path / "photos", "photos/")
    with zipfile.ZipFile(path, "a") as out:
        out.writestr("__MACOSX/photos/._IMG_0.jpg", b"x")
        out.writestr("photos/notes.txt", b"x")
    packed = Stages(tmp_path / "w1").ingest(path)
    plain = Stages(tmp_path / "w2").ingest(tmp_path / "photos")
    assert packed.background == "masked"
    for a, b in zip(packed.items, plain.items, strict=True):
        assert (a.name, a.source, a.sharpness) == (b.name, b.source, b.sharpness)
    assert Capture((path,)).files() == [("a.zip", path)]


def test_a_zip_that_leads_elsewhere_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = zipfile.ZipInfo("link.jpg")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    for member, words in (
        ("/etc/a.jpg", "absolute path"),
        ("C:\\a.jpg", "absolute path"),
        ("../a.jpg", "leads outside"),
        ("a\\..\\..\\b.jpg", "leads outside"),
        (link, "is a link"),
        ("more.zip", "a ZIP in the ZIP"),
    ):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as out:
            out.writestr(member, b"x")
        with pytest.raises(CaptureError, match=words):
            Capture((tmp_path / "a.zip",)).files()
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("a.jpg", bytes(1_000_000))
        out.writestr("b.jpg", b"x")
    for name, value, words in (
        ("MAX_MEMBERS", 1, "2 files; at most 1"),
        ("MAX_BYTES", 1000, "1.0 MB unpacked; at most 1.0 kB"),
        ("SMALL", 1000, "times its size"),
    ):
        with monkeypatch.context() as changed:
            changed.setattr(archive, name, value)
            with pytest.raises(CaptureError, match=words):
                Capture((tmp_path / "a.zip",)).files()
    data = bytearray((tmp_path / "a.zip").read_bytes())
    entry = data.find(b"PK\x01\x02")
    data[entry + 8] |= 1
    (tmp_path / "b.zip").write_bytes(data)
    with pytest.raises(CaptureError, match="is encrypted"):
        Capture((tmp_path / "b.zip",)).files()
    (tmp_path / "c.zip").write_bytes(data[: len(data) // 2])
    with pytest.raises(CaptureError, match=r"c\.zip: damaged"):
        Capture((tmp_path / "c.zip",)).files()


def test_a_damaged_member_of_a_zip_is_named(stages: Stages, tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 3)
    path = pack(tmp_path / "a.zip", tmp_path / "photos")
    data = bytearray(path.read_bytes())
    data[300:310] = bytes(10)
    path.write_bytes(data)
    with pytest.raises(CaptureError, match=r"IMG_0\.jpg is damaged"):
        stages.ingest(path)


def test_names_that_are_no_utf8_work_to_the_end(stages: Stages, photos: Path) -> None:
    for i in range(4):
        Image.fromarray(picture(i)).save(photos / "a.png")
        (photos / "a.png").rename(os.fsdecode(os.fsencode(photos) + b"/IMG_\xff%d.png" % i))
    broken = os.fsdecode(os.fsencode(photos) + b"/x\xfe.jpg")
    Path(broken).write_bytes(b"\xff\xd8\xff")
    views = stages.ingest(photos)
    assert [view.source for view in views.items] == [f"IMG_\\xff{i}.png" for i in range(4)]
    assert fingerprint(Capture((photos,)).files(), photos.parent / "memory.json").digest
    for text in (*stages.warnings, json.dumps([vars(s) for s in views.skipped])):
        text.encode("utf-8")
    assert "x\\xfe.jpg" in stages.warnings[0]


@pytest.mark.parametrize("folder", ["Masks", "MASKS", "mask"])
def test_masks_are_found_however_their_folder_is_spelled(
    stages: Stages, photos: Path, folder: str
) -> None:
    write_photos(photos)
    (photos / folder).mkdir()
    for name in ("IMG_0", "IMG_1", "IMG_2", "IMG_7"):
        Image.fromarray(disc()).save(photos / folder / f"{name}.png")
    assert stages.ingest(photos).background == "masked"
    (warning,) = stages.warnings
    assert warning == f"1 masks belong to no photo: {folder}/IMG_7.png"


def test_masks_may_lie_beside_the_photos_of_each_sub_folder(stages: Stages, photos: Path) -> None:
    for i, day in enumerate(("a", "b", "c")):
        (photos / day / "masks").mkdir(parents=True)
        Image.fromarray(picture(i)).save(photos / day / "1.jpg")
        Image.fromarray(disc(48 + i, 64)).resize((64, 48)).save(photos / day / "masks" / "1.png")
    views = stages.ingest(photos)
    assert [view.mask is None for view in views.items] == [False] * 3
    assert stages.warnings == []


def test_notes_and_sidecars_are_no_part_of_a_capture(photos: Path) -> None:
    write_photos(photos)
    before = Capture((photos,)).files()
    for name in ("notes.txt", "IMG_0.xmp", "IMG_0.AAE", "Thumbs.db", ".DS_Store", "._IMG_0.jpg"):
        (photos / name).write_bytes(b"text")
    assert Capture((photos,)).files() == before


def test_pictures_that_show_nothing_are_left_out_by_name(stages: Stages, photos: Path) -> None:
    write_photos(photos, 3)
    rng = np.random.default_rng(0)
    Image.new("RGB", (1, 1), (200, 10, 10)).save(photos / "dot.png")
    Image.fromarray(rng.integers(0, 3, (96, 128, 3), np.uint8)).save(photos / "black.png")
    Image.new("RGB", (128, 96), (255, 255, 255)).save(photos / "white.png")
    Image.new("RGB", (128, 96), (90, 120, 30)).save(photos / "plain.png")
    views = stages.ingest(photos)
    assert len(views.items) == 3
    reasons = {skipped.name: skipped.reason for skipped in views.skipped}
    for name, words in (
        ("dot.png", "only 1 x 1 pixels"),
        ("black.png", "all black"),
        ("white.png", "all white"),
        ("plain.png", "of one colour"),
    ):
        assert words in reasons[name] and name in stages.warnings[0]


CANON = Exif(focal_mm=55.0, sensor_width_mm=22.98, exif_width=4272, exif_height=2848)


def test_the_exif_of_resized_and_cropped_photos_gives_a_right_focal_length_or_none() -> None:
    """The true sensor is 22.3 mm wide; its maker's pixels per inch give 22.98."""
    resized = held_against(CANON, 1600, 1067)
    assert resized.focal_fraction == pytest.approx(55 / 22.3, rel=0.035)
    assert held_against(CANON, 1067, 1600).focal_fraction == resized.focal_fraction
    rewritten = Exif(focal_mm=55.0, sensor_width_mm=8.61, exif_width=1600, exif_height=1067)
    assert held_against(rewritten, 1600, 1067).focal_fraction is None
    assert held_against(CANON, 2000, 2000).focal_fraction is None
    assert held_against(CANON, 4272, 2848).focal_fraction == pytest.approx(55 / 22.98)
    phone = Exif(focal_35mm=26.0, exif_width=4032, exif_height=3024)
    assert held_against(phone, 1600, 1200).focal_fraction == pytest.approx(26 / 36)
    assert held_against(phone, 1600, 1600).focal_fraction is None


@needs_shared
def test_the_skulls_photos_give_a_right_focal_length_and_their_flash() -> None:
    path = sorted((SHARED / "photos" / "skull").glob("*.JPG"))[0]
    exif = held_against(read_exif(path), *Image.open(path).size)
    assert exif.focal_fraction == pytest.approx(55 / 22.3, rel=0.035)
    assert exif.flash is True and (exif.exif_width, exif.exif_height) == (4272, 2848)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError(errno.ENOMEM, "no memory"),
        OSError("out of memory error when reading image file"),
        cv2.error("OpenCV: Failed to allocate 99 bytes in function 'OutOfMemoryError'"),
        OSError(errno.EIO, "Input/output error"),
    ],
)
def test_a_photo_is_never_skipped_because_the_machine_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    from refdgs_pipe.files import images

    write_photos(tmp_path / "photos", 4)

    def fail(path: Path, *_: object) -> None:
        if path.name == "IMG_2.jpg":
            raise error

    monkeypatch.setattr(images, "_is_16bit", fail)
    with pytest.raises((MemoryError, OutOfMemory, DiskFault)):
        Stages(tmp_path).ingest(tmp_path / "photos")
