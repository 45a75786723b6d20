"""Photos are told by content, turned upright, decoded strictly."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from refdgs_pipe.errors import CaptureError, CorruptError
from refdgs_pipe.files.images import read_header, read_photo, read_png, sniff, write_png


def picture(height: int = 40, width: int = 60) -> np.ndarray:
    """No two corners alike, smooth enough for JPEG."""
    y, x = np.mgrid[0:height, 0:width]
    channels = (x / width, y / height, (x + y) / (width + height))
    return (np.stack(channels, -1) * 200 + 20).astype(np.uint8)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_all_eight_orientations_give_the_same_upright_picture(
    tmp_path: Path, orientation: int
) -> None:
    """Stored with Pillow's inverse of what its own exif_transpose does."""
    methods = {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }
    upright = Image.fromarray(picture())
    stored = upright.transpose(methods[orientation]) if orientation > 1 else upright
    exif = Image.Exif()
    exif[0x0112] = orientation
    for suffix in ("jpg", "png", "webp", "tif"):
        options = {"quality": 98} if suffix in ("jpg", "webp") else {}
        stored.save(tmp_path / f"a.{suffix}", exif=exif, **options)
        pixels = read_photo(tmp_path / f"a.{suffix}").astype(int)
        assert pixels.shape == (40, 60, 3)
        assert np.abs(pixels - picture()).max() <= 12  # lossy formats


def test_the_format_is_told_by_content_not_by_suffix(tmp_path: Path) -> None:
    Image.fromarray(picture()).save(tmp_path / "a.png")
    (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    assert sniff(tmp_path / "a.jpg") == "png"
    np.testing.assert_array_equal(read_photo(tmp_path / "a.jpg"), picture())


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bits_stay_sixteen_bits(tmp_path: Path, suffix: str) -> None:
    wide = picture().astype(np.uint16) * 257 + 3
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), wide[..., ::-1])
    np.testing.assert_array_equal(read_photo(tmp_path / f"a.{suffix}"), wide)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_truncated_jpeg_is_refused(tmp_path: Path, share: float) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (200, 300, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "whole.jpg")
    data = (tmp_path / "whole.jpg").read_bytes()
    (tmp_path / "cut.jpg").write_bytes(data[: int(len(data) * share)])
    with pytest.raises(CaptureError, match=r"cut\.jpg"):
        read_photo(tmp_path / "cut.jpg")


def test_a_jpeg_with_data_after_its_end_is_read(tmp_path: Path) -> None:
    """Motion photos carry a film behind the picture."""
    Image.fromarray(picture()).save(tmp_path / "a.jpg")
    with (tmp_path / "a.jpg").open("ab") as file:
        file.write(b"film" * 100)
    assert read_photo(tmp_path / "a.jpg").shape == (40, 60, 3)


def test_a_header_of_absurd_size_is_refused_before_decoding(tmp_path: Path) -> None:
    header = struct.pack(">IIBBBBB", 65535, 65535, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + header
    data = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk
    data += struct.pack(">I", zlib.crc32(chunk)) + struct.pack(">I", 0) + b"IEND\xaeB`\x82"
    (tmp_path / "bomb.png").write_bytes(data)
    with pytest.raises(CaptureError, match="bomb"):
        read_header(tmp_path / "bomb.png")


def test_what_is_no_photo_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("hello")
    with pytest.raises(CaptureError, match=r"a\.jpg: not a photo"):
        read_photo(tmp_path / "a.jpg")
    (tmp_path / "b.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(40))
    with pytest.raises(CaptureError, match=r"b\.heic: damaged heic header"):
        read_photo(tmp_path / "b.heic")


def test_other_colour_spaces_become_srgb(tmp_path: Path) -> None:
    """A Lab profile stands for any that is not sRGB: its numbers must change."""
    linear = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    Image.fromarray(picture()).save(tmp_path / "s.png", icc_profile=linear.tobytes())
    assert np.abs(read_photo(tmp_path / "s.png").astype(int) - picture()).max() <= 1
    (tmp_path / "t.png").write_bytes((tmp_path / "s.png").read_bytes())
    Image.fromarray(picture()).save(tmp_path / "t.png", icc_profile=b"not a profile")
    np.testing.assert_array_equal(read_photo(tmp_path / "t.png"), picture())


def test_grey_palette_and_cmyk_become_rgb(tmp_path: Path) -> None:
    image = Image.fromarray(picture())
    for mode, suffix in (("L", "png"), ("P", "png"), ("CMYK", "jpg"), ("LA", "png")):
        image.convert(mode).save(tmp_path / f"{mode}.{suffix}")
        channels = 4 if mode == "LA" else 3
        assert read_photo(tmp_path / f"{mode}.{suffix}").shape == (40, 60, channels)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
def test_our_pngs_come_back_bit_by_bit(tmp_path: Path, dtype: type, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    write_png(tmp_path / "below" / "a.png", pixels)
    np.testing.assert_array_equal(read_png(tmp_path / "below" / "a.png"), pixels)


def test_a_damaged_png_of_ours_is_a_corrupt_file(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no")
    for name in ("a.png", "missing.png"):
        with pytest.raises(CorruptError, match=name):
            read_png(tmp_path / name)
