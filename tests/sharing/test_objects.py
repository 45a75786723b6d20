"""Shared results: what is pushed comes back the same, and nothing wrong is ever used."""

import errno
import json
import os
import random
import threading
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from refdgs_pipe.errors import CorruptError, DiskFault, InputError, WriteError
from refdgs_pipe.pipeline.manifest import Manifest, Origin, Record, digest_of
from refdgs_pipe.pipeline.shared import Sharing
from refdgs_pipe.pipeline.store import Store
from refdgs_pipe.sharing import upkeep
from refdgs_pipe.sharing.objects import Objects, bytes_path, record_path
from refdgs_pipe.sharing.places import check_place, look_at, open_place

obstore = pytest.importorskip("obstore", reason="obstore is not installed: the extra batch")
from obstore.exceptions import GenericError  # noqa: E402
from obstore.store import LocalStore, MemoryStore  # noqa: E402

ORIGIN = Origin("train", 1, {"a": 1}, {"x": "y"})
FILES = {"field": b"field" * 1000, "parts/0.bin": b"zero", "parts/1.bin": b"", "copy": b"zero"}


@pytest.fixture(params=["memory", "local"])
def objects(request: pytest.FixtureRequest, tmp_path: Path) -> Objects:
    if request.param == "memory":
        return Objects(MemoryStore(), "memory")
    return Objects(LocalStore(tmp_path / "share", mkdir=True), str(tmp_path / "share"))


class Machine:
    """A workspace that shares its results."""

    def __init__(self, root: Path, objects: Objects, files: dict[str, bytes] = FILES) -> None:
        root.mkdir()
        self.store, self.objects, self.files = Store(root), objects, files
        self.told: list[str] = []
        self.sharing = Sharing(objects, self.store, lambda _, words: self.told.append(words))

    def make(self, origin: Origin = ORIGIN) -> Manifest:
        """Make the result here, and share it."""
        folder = self.store.partial(origin)
        for name, data in self.files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)
        manifest = self.store.commit(folder, origin, Record(1.0, {"a.jpg": "0" * 32}))
        self.sharing.offer(manifest)
        return manifest

    def fetch(self, origin: Origin = ORIGIN) -> Manifest | None:
        """The shared result, brought here."""
        return self.sharing.bring(origin)

    def whole(self, origin: Origin = ORIGIN) -> bool:
        """Whether the result is here, with exactly its bytes."""
        folder = self.store.folder(origin)
        return all((folder / name).read_bytes() == data for name, data in self.files.items())


def machines(tmp_path: Path, objects: Objects) -> tuple[Machine, Machine]:
    """One that made the result, and one that wants it and knows nothing."""
    farm = Machine(tmp_path / "farm", objects)
    farm.make()
    return farm, Machine(tmp_path / "laptop", Objects(objects.store, objects.place))


def test_a_result_comes_back_byte_for_byte(tmp_path: Path, objects: Objects) -> None:
    farm, laptop = machines(tmp_path, objects)
    manifest = laptop.fetch()
    assert manifest == farm.store.find(ORIGIN) == laptop.store.find(ORIGIN)
    assert laptop.whole() and laptop.told == []
    laptop.store.check(laptop.store.find(ORIGIN))  # type: ignore[arg-type]


def test_the_layout_is_records_by_key_and_bytes_by_hash(tmp_path: Path, objects: Objects) -> None:
    farm, _ = machines(tmp_path, objects)
    manifest = farm.store.find(ORIGIN)
    assert manifest is not None
    found = {meta["path"] for page in objects.store.list() for meta in page}
    digests = {digest for _, digest in manifest.files.values()}
    assert found == {f"ac/train/{ORIGIN.key}.json"} | {f"cas/{d[:2]}/{d}" for d in digests}
    assert len(digests) == 3  # equal files are one


def test_requests_are_one_for_each_file_and_three_for_the_record(tmp_path: Path) -> None:
    farm = Machine(tmp_path / "farm", Objects(MemoryStore(), "memory"))
    assert farm.fetch() is None
    farm.make()
    assert farm.objects.requests == {"get": 1, "head": 1 + 4, "put": 3 + 1}
    later = Objects(farm.objects.store, "memory")
    Sharing(later, farm.store, print).offer(farm.store.find(ORIGIN))  # type: ignore[arg-type]
    assert later.requests == {"head": 1}
    laptop = Machine(tmp_path / "laptop", Objects(farm.objects.store, "memory"))
    laptop.fetch()
    assert laptop.objects.requests == {"get": 1 + 4}


def test_what_is_not_shared_is_made_here(tmp_path: Path, objects: Objects) -> None:
    laptop = Machine(tmp_path / "laptop", objects)
    assert laptop.fetch() is None and laptop.told == []
    assert list((tmp_path / "laptop").iterdir()) == []


def test_the_record_goes_last(tmp_path: Path) -> None:
    order: list[str] = []

    class Watched:
        def __init__(self) -> None:
            self.inner = MemoryStore()

        def __getattr__(self, name: str) -> Any:
            return getattr(self.inner, name)

        def put(self, path: str, data: Any, **options: Any) -> Any:
            order.append(path)
            return self.inner.put(path, data, **options)

    Machine(tmp_path / "farm", Objects(Watched(), "watched")).make()
    assert [path.partition("/")[0] for path in order] == ["cas"] * 3 + ["ac"]


def test_of_sixteen_racing_writers_one_wins_and_all_read_its_result(
    tmp_path: Path, objects: Objects
) -> None:
    writers = [
        Machine(tmp_path / f"w{i}", Objects(objects.store, objects.place), {"who": b"%d" % i})
        for i in range(16)
    ]
    gate = threading.Barrier(16)

    def race(writer: Machine) -> None:
        gate.wait()
        writer.make()

    threads = [threading.Thread(target=race, args=(writer,)) for writer in writers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not any(writer.told for writer in writers)
    readers = [Machine(tmp_path / f"r{i}", Objects(objects.store, "x"), {}) for i in range(3)]
    digests = {found.digest for reader in readers if (found := reader.fetch())}
    assert len(digests) == 1


Damage = tuple[str, Any]


def broken_record(text: dict[str, Any]) -> Iterator[Damage]:
    """Records that must not be believed."""
    whole = json.dumps(text)
    yield "not readable", whole[: len(whole) // 2].encode()
    yield "not UTF-8", b"\xff\xfe" + whole.encode()
    yield "it was changed", json.dumps(text | {"seconds": 99.0}).encode()
    yield "no checksum", json.dumps({k: v for k, v in text.items() if k != "checksum"}).encode()
    other = text | {"origin": text["origin"] | {"version": 2}}
    yield "not readable", json.dumps(other).encode()
    yield "not readable", b"[]"


@pytest.mark.parametrize("number", range(6))
def test_a_poisoned_record_is_refused_named_and_replaced(
    tmp_path: Path, objects: Objects, number: int
) -> None:
    farm, laptop = machines(tmp_path, objects)
    path = record_path("train", ORIGIN.key)
    text = json.loads(bytes(objects.store.get(path).bytes()))
    words, data = list(broken_record(text))[number]
    objects.store.put(path, data)
    assert laptop.fetch() is None
    assert words in laptop.told[0] and f"{objects.place}/{path}" in laptop.told[0]
    laptop.make()
    assert Machine(tmp_path / "third", farm.objects).fetch() is not None


@pytest.mark.parametrize(
    "names",
    [
        ["../out"],
        ["/etc/passwd"],
        ["a", "a/b"],
        ["a", "./a"],
        ["manifest.json"],
        ["C:/x"],
        ["a" * 300],
    ],
)
def test_a_record_with_names_that_lead_out_or_hide_one_another_is_refused(
    tmp_path: Path, objects: Objects, names: list[str]
) -> None:
    farm, laptop = machines(tmp_path, objects)
    real = farm.store.find(ORIGIN)
    assert real is not None
    content = real.files["copy"]
    files = dict.fromkeys(names, content)
    forged = Manifest(ORIGIN, digest_of(files), 1.0, "", files, {})
    objects.store.put(record_path("train", ORIGIN.key), json.dumps(forged.record()).encode())
    assert laptop.fetch() is None and "refused" in laptop.told[0]
    assert not laptop.store.folder(ORIGIN).exists() and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"fiel", "4 bytes, 5000 expected"),
        (b"fiele" * 1000, "its content is not what its name says"),
        (None, "missing"),
    ],
)
def test_poisoned_bytes_are_refused_named_and_replaced(
    tmp_path: Path, objects: Objects, data: bytes | None, words: str
) -> None:
    farm, laptop = machines(tmp_path, objects)
    manifest = farm.store.find(ORIGIN)
    assert manifest is not None
    path = bytes_path(manifest.files["field"][1])
    if data is None:
        objects.store.delete(path)
    else:
        objects.store.put(path, data)
    assert laptop.fetch() is None
    assert words in laptop.told[0] and f"{objects.place}/{path}" in laptop.told[0]
    assert not laptop.store.folder(ORIGIN).exists()
    laptop.make()
    third = Machine(tmp_path / "third", Objects(objects.store, "x"))
    assert third.fetch() is not None and third.whole()


class Flaky:
    """A store that fails now and then.

    Args:
        kind: one of FAULTS.
        chance: of a failure, for each request that can fail so.
    """

    def __init__(self, inner: Any, kind: str, chance: float, seed: int) -> None:
        self.inner, self.kind, self.chance = inner, kind, chance
        self.random = random.Random(seed)
        self.faults = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def fails(self, kind: str) -> bool:
        """Whether a request that can fail in this way does so now."""
        fails = self.kind == kind and self.random.random() < self.chance
        self.faults += fails
        return fails

    def head(self, path: str) -> Any:
        if self.fails("busy"):
            raise GenericError("503 Slow Down")
        return self.inner.head(path)

    def put(self, path: str, data: Any, **options: Any) -> Any:
        if self.fails("busy"):
            raise GenericError("503 Slow Down")
        if path.startswith("cas") and self.fails("torn upload"):
            whole = data.read_bytes() if isinstance(data, Path) else data
            self.inner.put(path, whole[: len(whole) // 2])
            raise GenericError("connection reset")
        if self.fails("full store"):
            raise GenericError("507 Insufficient Storage")
        return self.inner.put(path, data, **options)

    def get(self, path: str) -> Any:
        if self.fails("busy"):
            raise GenericError("503 Slow Down")
        return Answer(self.inner.get(path), self)


class Answer:
    """What a flaky store gives: sometimes less, or something else."""

    def __init__(self, inner: Any, store: Flaky) -> None:
        self.meta, self._data = inner.meta, bytes(inner.bytes())
        self._is_cut = store.fails("cut")
        if self._data and store.fails("wrong bytes"):
            at = store.random.randrange(len(self._data))
            self._data = self._data[:at] + bytes([self._data[at] ^ 1]) + self._data[at + 1 :]
        elif store.fails("truncated"):
            self._data = self._data[: len(self._data) // 2]

    def bytes(self) -> bytes:
        if self._is_cut:
            raise GenericError("connection closed before the message was complete")
        return self._data

    def stream(self, _: int) -> Iterator[bytes]:
        for start in range(0, len(self._data), 1000):
            yield self._data[start : start + 1000]
            if self._is_cut:
                raise GenericError("connection closed before the message was complete")


FAULTS = ("busy", "cut", "truncated", "wrong bytes", "torn upload", "full store")
MANY = [12, pytest.param(1000, marks=pytest.mark.slow)]  # of each kind of fault


@pytest.mark.parametrize("faults", MANY)
@pytest.mark.parametrize("kind", FAULTS)
def test_faults_let_nothing_wrong_through_and_lose_nothing(
    tmp_path: Path, kind: str, faults: int
) -> None:
    flaky = Flaky(MemoryStore(), kind, 0.25, seed=3)

    def machine_for(number: int, name: str) -> tuple[Machine, Origin]:
        origin = Origin("train", 1, {"number": number}, {"x": "y"})
        files = {**FILES, "field": b"%d " % number * 1000}
        return Machine(tmp_path / name, Objects(flaky, "flaky"), files), origin

    rounds = 0
    while flaky.faults < faults:
        rounds += 1
        machine, origin = machine_for(rounds // 4, str(rounds))
        if machine.fetch(origin) is None:
            machine.make(origin)
        assert machine.whole(origin)
        found = machine.store.find(origin)
        assert found is not None
        machine.store.check(found)
    flaky.chance = 0.0
    for number in range(rounds // 4):  # whatever is shared at the end is whole, or is refused
        machine, origin = machine_for(number, f"last{number}")
        if machine.fetch(origin) is not None:
            assert machine.whole(origin)
        else:
            machine.make(origin)
            again, _ = machine_for(number, f"again{number}")
            assert again.fetch(origin) is not None and again.whole(origin)


class Full(Objects):
    """Files are fetched to a disk that is sometimes full."""

    is_full = False

    def _download(self, digest: str, size: int, path: Path) -> None:
        super()._download(digest, size, path)
        if self.is_full:
            os.truncate(path, size // 2)
            raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("faults", MANY)
def test_full_disks_leave_no_half_result_and_lose_nothing(tmp_path: Path, faults: int) -> None:
    farm = Machine(tmp_path / "farm", Objects(MemoryStore(), "memory"))
    farm.make()
    for number in range(faults):
        objects = Full(farm.objects.store, "memory")
        laptop = Machine(tmp_path / str(number), objects)
        objects.is_full = True
        with pytest.raises(WriteError, match="no space left"):
            laptop.fetch()
        assert not laptop.store.folder(ORIGIN).exists()
        assert not list(laptop.store.root.glob("train/.partial-*"))
        objects.is_full = False
        again = Machine(tmp_path / f"{number}-again", objects)  # after room was made
        assert again.fetch() is not None and again.whole()


class Skewed:
    """A store whose clock is wrong by that much."""

    def __init__(self, inner: Any, skew: timedelta) -> None:
        self.inner, self.skew = inner, skew

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def _as_told(self, meta: Any) -> Any:
        return {**meta, "last_modified": meta["last_modified"] + self.skew}

    def head(self, path: str) -> Any:
        return self._as_told(self.inner.head(path))

    def list(self, *arguments: Any, **options: Any) -> Iterator[list[Any]]:
        for page in self.inner.list(*arguments, **options):
            yield [self._as_told(meta) for meta in page]


@pytest.mark.parametrize("faults", MANY)
def test_wrong_clocks_delete_nothing_new_and_keep_nothing_old(tmp_path: Path, faults: int) -> None:
    inner, drawn = MemoryStore(), random.Random(5)
    for number in range(faults):
        skew = timedelta(days=drawn.uniform(-4000, 4000))
        store = Skewed(inner, skew)
        farm = Machine(tmp_path / f"farm{number}", Objects(store, "skewed"))
        farm.make()
        assert upkeep.collect(farm.objects, timedelta(days=1), lambda _: False).records == 0
        laptop = Machine(tmp_path / f"laptop{number}", Objects(store, "skewed"))
        assert laptop.fetch() is not None and laptop.whole()
        assert upkeep.collect(farm.objects, timedelta(0), lambda _: False).records == 1


def test_a_store_that_fails_is_told_once_and_the_rest_is_made_here(tmp_path: Path) -> None:
    flaky = Flaky(MemoryStore(), "busy", 1.0, seed=0)
    laptop = Machine(tmp_path / "laptop", Objects(flaky, "s3://shop"))
    assert laptop.fetch() is None
    laptop.make()
    assert len(laptop.told) == 1
    assert "s3://shop: the shared results cannot be used (503 Slow Down)" in laptop.told[0]
    assert laptop.whole()


def test_a_place_that_may_only_be_read_is_still_read(tmp_path: Path) -> None:
    inner = MemoryStore()
    other = Origin("bake", 1, {}, {})
    Machine(tmp_path / "farm", Objects(inner, "shop")).make(other)

    class ReadOnly(Flaky):
        def put(self, path: str, data: Any, **options: Any) -> Any:
            raise GenericError("403 Forbidden")

    laptop = Machine(tmp_path / "laptop", Objects(ReadOnly(inner, "busy", 0.0, seed=0), "shop"))
    laptop.make()
    laptop.make(Origin("gate", 1, {}, {}))
    assert len(laptop.told) == 1 and "offers no results" in laptop.told[0]
    assert laptop.fetch(other) is not None


def test_a_full_disk_is_an_error_and_leaves_no_half_result(
    tmp_path: Path, objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, laptop = machines(tmp_path, objects)

    def full(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(laptop.objects, "_download", full)
    with pytest.raises(WriteError, match="no space left"):
        laptop.fetch()
    assert not laptop.store.folder(ORIGIN).exists()
    assert not list(laptop.store.root.glob("train/.partial-*"))


def test_verify_names_what_is_damaged_and_deletes_it_when_asked(
    tmp_path: Path, objects: Objects
) -> None:
    farm, _ = machines(tmp_path, objects)
    other = Origin("bake", 1, {}, {})
    farm.make(other)
    manifest = farm.store.find(ORIGIN)
    assert manifest is not None
    assert upkeep.verify(objects).bad == {}
    path = bytes_path(manifest.files["field"][1])
    objects.store.put(path, b"fiele" * 1000)
    objects.store.put(record_path("bake", other.key), b"{")
    found = upkeep.verify(objects, delete=True)
    assert set(found.bad) == {path, record_path("bake", other.key)}
    assert upkeep.verify(objects) == upkeep.Verified(0, 0, 0, {})


def test_old_results_and_files_without_a_record_go_and_what_is_kept_stays(
    tmp_path: Path, objects: Objects, monkeypatch: pytest.MonkeyPatch
) -> None:
    machines(tmp_path, objects)
    other = Origin("bake", 1, {}, {})
    Machine(tmp_path / "other", objects, {"other": b"bytes"}).make(other)
    objects.store.put("cas/ff/" + "f" * 32, b"nobody needs it")
    monkeypatch.setattr(upkeep, "GRACE", timedelta(0))
    assert upkeep.collect(objects, timedelta(days=1), lambda _: False).records == 0
    assert objects.requests  # the file that no record needs went all the same
    with pytest.raises(FileNotFoundError):
        objects.store.head("cas/ff/" + "f" * 32)
    keep = {f"bake/{other.key}"}
    would = upkeep.collect(objects, timedelta(0), keep.__contains__, dry_run=True)
    assert (would.records, would.files) == (1, 3)
    assert upkeep.collect(objects, timedelta(0), keep.__contains__) == would
    assert Machine(tmp_path / "a", objects).fetch() is None
    assert Machine(tmp_path / "b", objects, {}).fetch(other) is not None


def test_a_young_file_without_a_record_stays(tmp_path: Path, objects: Objects) -> None:
    objects.store.put("cas/ff/" + "f" * 32, b"a record may follow")
    upkeep.collect(objects, timedelta(0), lambda _: False)
    assert objects.store.head("cas/ff/" + "f" * 32)["size"] == 19


@pytest.mark.parametrize(
    "place",
    [
        "",
        "ftp://host/x",
        "https://bucket.s3.amazonaws.com/x",
        "s3://key:secret@bucket/x",
        "s3:///x",
        "s3://bucket/../other",
        "s3://bucket/x?secret=1",
    ],
)
def test_a_place_that_cannot_be_meant_is_refused(place: str) -> None:
    with pytest.raises(InputError, match="expected s3://"):
        check_place(place)


def test_a_folder_that_is_not_mounted_may_be_there_later(tmp_path: Path) -> None:
    with pytest.raises(DiskFault, match="no such folder here"):
        open_place(str(tmp_path / "share"))
    with pytest.raises(DiskFault, match="no such folder here"):
        look_at(str(tmp_path / "mnt" / "share"))
    look_at(str(tmp_path / "share"))
    open_place(str(tmp_path / "share"))


def test_reading_a_record_of_another_size_is_refused_before_it_is_read(objects: Objects) -> None:
    objects.store.put("ac/train/" + "0" * 16 + ".json", b" " * 100)
    with pytest.raises(CorruptError):
        objects.record("ac/train/" + "0" * 16 + ".json")


def test_a_file_that_stops_in_the_middle_is_a_fault_of_the_place_and_not_of_the_file() -> None:
    flaky = Flaky(MemoryStore(), "cut", 0.0, seed=0)
    flaky.inner.put(bytes_path("0" * 32), b"x" * 5000)
    flaky.chance, flaky.random = 1.0, random.Random(1)
    with pytest.raises(DiskFault):
        list(Objects(flaky, "flaky").bytes_of("0" * 32, 5000))
