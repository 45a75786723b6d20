"""Laws of hashing photos, and of not hashing them again."""

import hashlib
import json
import os
from pathlib import Path

import pytest

from refdgs_pipe.errors import CaptureError
from refdgs_pipe.pipeline import fingerprint as module
from refdgs_pipe.pipeline.fingerprint import combine, fingerprint, hash_file


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "a.jpg"
    path.write_bytes(b"one")
    return path


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the files that are read."""
    names: list[str] = []
    real = module.hash_file

    def listening(path: Path, like: str = "") -> str:
        names.append(path.name)
        return real(path, like)

    monkeypatch.setattr(module, "hash_file", listening)
    return names


def settle(monkeypatch: pytest.MonkeyPatch, seconds: float = 10) -> None:
    """Let time pass."""
    later = module.time.time_ns() + int(seconds * 1e9)
    monkeypatch.setattr(module.time, "time_ns", lambda: later)


def test_an_unchanged_photo_is_not_read_again(
    photo: Path, hashed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(monkeypatch)
    memory = photo.parent / "memory"
    first = fingerprint([("a", photo)], memory)
    assert fingerprint([("a", photo)], memory) == first
    assert hashed == ["a.jpg"]


def test_a_photo_changed_with_its_size_and_date_kept_is_read_again(
    photo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(monkeypatch)
    memory, dates = photo.parent / "memory", photo.stat()
    first = fingerprint([("a", photo)], memory)
    photo.write_bytes(b"two")
    os.utime(photo, ns=(dates.st_atime_ns, dates.st_mtime_ns))
    assert fingerprint([("a", photo)], memory) != first


def test_a_photo_that_was_written_just_now_is_not_trusted(photo: Path, hashed: list[str]) -> None:
    memory = photo.parent / "memory"
    fingerprint([("a", photo)], memory)
    fingerprint([("a", photo)], memory)
    assert hashed == ["a.jpg", "a.jpg"]


@pytest.mark.parametrize("text", ["", "{", '{"files": 3}', '{"files": {"a": [1]}}', "[]"])
def test_a_broken_memory_is_only_slow(
    photo: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(monkeypatch)
    memory = photo.parent / "memory"
    memory.write_text(text)
    known = fingerprint([("a", photo)], memory)
    memory.unlink()
    assert fingerprint([("a", photo)], memory) == known


def test_names_count_but_not_their_order_or_place(photo: Path) -> None:
    memory, other = photo.parent / "memory", photo.parent / "b.jpg"
    other.write_bytes(b"two")
    mark = fingerprint([("a", photo), ("b", other)], memory)
    assert fingerprint([("b", other), ("a", photo)], memory).digest == mark.digest
    assert fingerprint([("b", photo), ("a", other)], memory).digest != mark.digest


def test_two_photos_of_one_name_both_count(photo: Path) -> None:
    memory, other = photo.parent / "memory", photo.parent / "b.jpg"
    other.write_bytes(b"two")
    both = fingerprint([("a", photo), ("a", other)], memory)
    assert len(both.files) == 2
    assert both.digest != fingerprint([("a", other)], memory).digest


def test_a_photo_that_cannot_be_read_is_named(photo: Path) -> None:
    with pytest.raises(CaptureError, match=r"gone\.jpg: cannot be read"):
        fingerprint([("a", photo.with_name("gone.jpg"))], photo.parent / "memory")


def older(path: Path) -> str:
    """A file's hash as older versions had it."""
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def test_hashes_have_256_bits_and_are_compared_with_those_of_128(photo: Path) -> None:
    assert hash_file(photo) == hashlib.blake2b(b"one", digest_size=32).hexdigest()
    assert hash_file(photo, like=older(photo)) == older(photo)
    assert hash_file(photo, like="c3") == hash_file(photo)  # no hash is as short as that


def test_hashes_of_older_hashes_stay_the_same(photo: Path) -> None:
    new, old = hash_file(photo), older(photo)
    line = hashlib.blake2b(f"a {old}\n".encode(), digest_size=16).hexdigest()
    assert combine({"a": old}) == line
    assert len(combine({"a": new})) == len(combine({"a": new, "b": old})) == 64


def test_photos_of_an_older_workspace_keep_their_hashes(
    photo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(monkeypatch)
    memory, stat = photo.parent / "memory", photo.stat()
    facts = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, older(photo)]
    memory.write_text(json.dumps({"files": {"a": facts}}))
    assert fingerprint([("a", photo)], memory).files == {"a": older(photo)}
    os.utime(photo, ns=(stat.st_atime_ns, stat.st_mtime_ns - 5_000_000_000))  # only touched
    assert fingerprint([("a", photo)], memory).files == {"a": older(photo)}
    photo.write_bytes(b"two")
    assert fingerprint([("a", photo)], memory).files == {"a": older(photo)}


def test_photos_of_an_older_workspace_are_read_anew_as_they_were(photo: Path) -> None:
    memory, last = photo.parent / "memory", {"a": older(photo)}
    assert fingerprint([("a", photo)], memory, last).files == last
    photo.write_bytes(b"two")
    assert fingerprint([("a", photo)], photo.parent / "none", last).files != last
