"""Pickled arrays are read as numpy writes them, and nothing in a pickle is ever run."""

import operator
import os
import pickle
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from refdgs_pipe.errors import CorruptError
from refdgs_pipe.files.pickled_arrays import MAX_BYTES, read_pickled_arrays

POSE = np.arange(12.0).reshape(3, 4) / 7
K = np.array([[400.0, 0, 200], [0, 400, 200], [0, 0, 1]])


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "0-camera.pkl"


@pytest.fixture
def canary(tmp_path: Path) -> Path:
    return tmp_path / "canary"


class Call:
    """Pickles as a call of a function, which may itself be the result of a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> Any:
        return self.function, self.arguments

    def __call__(self) -> None:
        """Only what can be called may be pickled as a function."""


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4", "<i8", ">i4"])
def test_arrays_come_back_as_they_were_pickled(file: Path, protocol: int, dtype: str) -> None:
    arrays = tuple(array.astype(dtype) for array in (POSE, np.asfortranarray(K), POSE[:, ::2]))
    file.write_bytes(pickle.dumps(arrays, protocol))
    found = read_pickled_arrays(file)
    assert len(found) == 3
    for one, other in zip(found, arrays, strict=True):
        assert one.dtype == np.float64
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_numpy_1_and_2_name_their_parts_differently(file: Path, protocol: int) -> None:
    class Renaming(pickle._Pickler):  # type: ignore[name-defined, misc]
        def save_global(self, obj: Any, name: Any = None) -> None:
            module = getattr(obj, "__module__", "")
            if "numpy._core" in module or "numpy.core" in module:
                self.save_as(module.replace("numpy._core", "numpy.core"), obj.__name__)
            else:
                super().save_global(obj, name)

        def save_as(self, module: str, name: str) -> None:
            if self.proto >= 4:
                self.save(module)
                self.save(name)
                self.write(pickle.STACK_GLOBAL)
            else:
                self.write(pickle.GLOBAL + f"{module}\n{name}\n".encode())

        dispatch: ClassVar[dict[Any, Any]] = {
            **pickle._Pickler.dispatch,  # type: ignore[attr-defined]
            type(len): save_global,
            type(lambda: 0): save_global,
        }

    with file.open("wb") as stream:
        Renaming(stream, protocol).dump((POSE, K))
    data = file.read_bytes()
    assert b"numpy.core" in data and b"numpy._core" not in data
    for text in (b"numpy.core.multiarray", b"numpy.core.numeric"):
        if protocol < 4:  # no lengths to correct
            data = data.replace(text, text.replace(b"core", b"_core", 1))
    for written in (file.read_bytes(), data):
        file.write_bytes(written)
        np.testing.assert_array_equal(read_pickled_arrays(file)[0], POSE)


def test_a_pickle_of_python_2_is_read(file: Path) -> None:
    raw = K.astype("<f8").tobytes()
    array = (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR"
        b"(K\x01K\x03K\x03\x86cnumpy\ndtype\n(U\x02f8K\x00K\x01tR"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U" + bytes([len(raw)]) + raw
    )
    file.write_bytes(b"\x80\x02" + array + b"tb\x85.")
    np.testing.assert_array_equal(read_pickled_arrays(file)[0], K)


def malicious(canary: Path) -> dict[str, Any]:
    """Pickled, each of these touches the canary when Python's own reader meets it."""
    touch = f"touch {canary}"
    opened = Call(open, str(canary), "w")
    return {
        "os.system": Call(os.system, touch),
        "os.system in the tuple": (POSE, Call(os.system, touch)),
        "eval": Call(eval, f"open({str(canary)!r}, 'w')"),
        "exec": Call(exec, f"open({str(canary)!r}, 'w')"),
        "open": opened,
        "subprocess": Call(subprocess.call, ["touch", str(canary)]),
        "getattr chain": Call(Call(getattr, Call(__import__, "os"), "system"), touch),
        "as an array's shape": Call(np.zeros, (opened, 1)),
        "attrgetter": Call(Call(operator.attrgetter("system"), Call(__import__, "os")), touch),
        "a map of calls": Call(list, Call(map, os.system, (touch,))),
        "mkdir": Call(os.mkdir, str(canary)),
        "numpy's writer": Call(np.savetxt, str(canary), (1.0,)),
    }


@pytest.mark.parametrize("name", malicious(Path("canary")))
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_what_a_pickle_would_run_is_not_run(
    file: Path, canary: Path, name: str, protocol: int
) -> None:
    file.write_bytes(pickle.dumps(malicious(canary)[name], protocol))
    assert not canary.exists()
    with pytest.raises(CorruptError, match="nothing in it was run") as caught:
        read_pickled_arrays(file)
    assert not canary.exists()
    assert file.name in str(caught.value)


@pytest.mark.parametrize("name", malicious(Path("canary")))
def test_pythons_own_reader_would_have_touched_the_canary(canary: Path, name: str) -> None:
    """Shows that the test above tests something."""
    data = pickle.dumps(malicious(canary)[name])
    with suppress(TypeError):  # np.zeros of an open file
        pickle.loads(data)
    assert canary.exists()


@pytest.mark.parametrize(
    "program",
    [
        b"cos\nsystem\n(S'touch CANARY'\ntR.",
        b"(S'touch CANARY'\nios\nsystem\n.",
        b"(cos\nsystem\nS'touch CANARY'\no.",
        b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x0ctouch CANARY\x85R.",
        b"\x80\x02c__builtin__\neval\n(X\x12\x00\x00\x00open('CANARY', 'w')tR.",
        b"\x80\x02cnumpy\nndarray\n(K\x01tR.",
        b"\x80\x02cnumpy\ndtype\n)\x81.",
        b"\x80\x02cnumpy\ndtype\n(cos\nsystem\ntR.",
        b"\x80\x02c_codecs\nencode\n(cnumpy\ndtype\ntR.",
        b"\x80\x02\x82\x01.",
        b"Pinjected\n.",
        b"\x80\x02}X\x01\x00\x00\x00aK\x01sb.",
        b"\x80\x02NK\x01b.",
        b"\x80\x02h\x07.",
        b"\x80\x02tR.",
        b"\x80\x02\x86.",
        b".",
        b"",
        b"not a pickle",
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7f",
        b"\x80\x04\x8e\x00\x00\x00\x00\x01\x00\x00\x00abc.",
        b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\xff\xff.",
        b"\x80\x02\x8b\xff\xff\xff\x7f.",
        b"\x80\x02" + b"(" * 30000 + b"t" * 30000 + b".",
        b"\x80\x04)" + b"\x94\x8c\x02os\x86" * 9000 + b"\x8c\x01x\x93.",  # a deep name
        b"\x80\x02)" + b"2\x86" * 200 + b".",
        b"\x80\x04)" + b"".join(b"q%c" % i + b"h%c" % i + b"\x86" for i in range(99)) + b"\x85.",
    ],
)
def test_hand_written_pickles_are_refused(
    file: Path, canary: Path, program: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(canary.parent)
    file.write_bytes(program.replace(b"CANARY", b"canary"))
    with pytest.raises(CorruptError, match="nothing in it was run"):
        read_pickled_arrays(file)
    assert not canary.exists()


def test_every_cut_of_a_pickle_is_called_damaged(file: Path) -> None:
    whole = pickle.dumps((POSE, K))
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(CorruptError, match=r"0-camera\.pkl: "):
            read_pickled_arrays(file)


def test_flipped_bytes_never_end_in_anything_but_arrays_or_the_error(file: Path) -> None:
    whole = pickle.dumps((POSE, K), 4)
    rng = np.random.default_rng(0)
    for _ in range(3000):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), 3):
            data[place] = rng.integers(0, 256)
        file.write_bytes(bytes(data))
        try:
            assert all(isinstance(array, np.ndarray) for array in read_pickled_arrays(file))
        except CorruptError:
            continue


def forged(shape: Any, dtype: str = "f8", data: Any = b"") -> bytes:
    """A pickled 1-tuple of an array that says anything about itself."""

    class Forged:
        def __reduce__(self) -> Any:
            make = np.empty(1).__reduce__()[0]
            return make, (np.ndarray, (0,), b"b"), (1, shape, np.dtype(dtype), False, data)

    return pickle.dumps((Forged(),))


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (forged((2**40,)), "no matrix"),
        (forged((4096, 4096)), "not the 134217728 of its shape"),
        (forged((-1, 3)), "no matrix"),
        (forged((3, 3), data=b"x" * 71), "not the 72"),
        (forged((1, 1, 1), data=b"x" * 8), "no matrix"),
        (forged((True, 1), data=b"x" * 8), "no matrix"),
        (forged((1,), "O", (1,)), "plain numbers"),
        (forged((1,), "V8", b"x" * 8), "plain numbers"),
        (forged((1,), "c16", b"x" * 16), "plain numbers"),
        (forged("abc"), "no matrix"),
        (forged((1,), data=7), "bytes"),
        (pickle.dumps({"K": 1}), "EMPTY_DICT"),
        (pickle.dumps([1]), "EMPTY_LIST"),
        (pickle.dumps(1), "else than a tuple"),
        (pickle.dumps((1, "two")), "else than arrays"),
        (pickle.dumps((np.ma.array([1.0]),)), "the name"),
        (b" " * (MAX_BYTES + 1), "larger than"),
    ],
)
def test_what_is_no_matrix_of_numbers_says_so(file: Path, data: bytes, word: str) -> None:
    file.write_bytes(data)
    with pytest.raises(CorruptError, match=word):
        read_pickled_arrays(file)


def test_a_missing_file_says_so(file: Path) -> None:
    with pytest.raises(CorruptError, match="cannot be read"):
        read_pickled_arrays(file)
