"""What a file is by its first bytes. Loads nothing heavy: `status` asks this too."""

import re
from pathlib import Path

RAW_SUFFIX = re.compile(r"\.(dng|cr[23]|nef|arw|raf|orf|rw2|pef|srw|kdc|dcr|3fr|iiq|erf|mos)", re.I)
PHOTO_SUFFIX = re.compile(r"\.(jpe?g|png|tiff?|webp|avif|hei[cf])", re.I)
VIDEO_SUFFIX = re.compile(r"\.(mp4|mov|m4v|avi|mkv|webm)", re.I)

_HEIF_BRANDS = (b"hei", b"hev", b"mif", b"msf")  # heic heix heim hevc mif1 msf1
_NO_VIDEO = (b"crx", b"avi", b"avc", *_HEIF_BRANDS)  # Canon RAW, AVIF


def sniff(path: Path) -> str:
    """The format by content: jpeg png webp tiff avif heic raw video zip, or "" for none of them.

    Most camera RAW files are TIFFs too: "tiff" may still be one.
    """
    with path.open("rb") as file:
        head = file.read(32)
    is_box, brand = head[4:8] == b"ftyp", head[8:11]
    kinds = (
        (head.startswith(b"\xff\xd8\xff"), "jpeg"),
        (head.startswith(b"\x89PNG\r\n\x1a\n"), "png"),
        (head[:4] == b"RIFF" and head[8:12] == b"WEBP", "webp"),
        (head[:4] in (b"II*\0", b"MM\0*"), "tiff"),
        (is_box and brand == b"avi", "avif"),
        (is_box and brand in _HEIF_BRANDS, "heic"),
        (head[4:11] == b"ftypcrx", "raw"),
        (head[:15] == b"FUJIFILMCCD-RAW", "raw"),
        (head[:4] in (b"IIRO", b"IIRS", b"MMOR", b"IIU\0", b"FOVb", b"\0MRM"), "raw"),
        (head[6:14] == b"HEAPCCDR", "raw"),
        (is_box and brand not in _NO_VIDEO, "video"),
        (head[4:8] in (b"moov", b"mdat", b"wide") and len(head) == 32, "video"),
        (head[:4] == b"RIFF" and head[8:12] == b"AVI ", "video"),
        (head[:4] == b"\x1aE\xdf\xa3", "video"),
        (head[:4] in (b"PK\x03\x04", b"PK\x05\x06"), "zip"),
    )
    return next((name for matches, name in kinds if matches), "")


def is_candidate(path: Path) -> bool:
    """Whether a file is a photo or a film, or is called like one and may be a damaged one."""
    if any(kind.fullmatch(path.suffix) for kind in (RAW_SUFFIX, PHOTO_SUFFIX, VIDEO_SUFFIX)):
        return True
    try:
        return sniff(path) not in ("", "zip")
    except OSError:
        return False
