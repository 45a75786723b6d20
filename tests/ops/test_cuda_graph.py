"""Recording, with a GPU's stand-in that notes what is asked of it."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from refdgs_pipe.ops.cuda_graph import Recorder


class Stand:
    """torch.cuda as far as a recorder uses it."""

    def __init__(self, *, ends: bool = True) -> None:
        self.said: list[str] = []
        self.ends, self.collects = ends, []
        self.graphs = 0

    def CUDAGraph(self) -> "Stand.Graph":
        self.graphs += 1
        return Stand.Graph(self, self.graphs)

    def Stream(self) -> "Stand":
        return self

    def current_stream(self) -> "Stand":
        return self

    def wait_stream(self, other: object) -> None:
        pass

    def synchronize(self) -> None:
        pass

    def graph_pool_handle(self) -> str:
        return "pool"

    @contextmanager
    def stream(self, stream: object) -> Iterator[None]:
        self.said.append("aside")
        yield
        self.said.append("back")

    class Graph:
        def __init__(self, gpu: "Stand", number: int) -> None:
            self.gpu, self.number = gpu, number

        def capture_begin(self, *, pool: str, capture_error_mode: str) -> None:
            assert pool == "pool" and capture_error_mode == "thread_local"
            self.gpu.said.append("begin")

        def capture_end(self) -> None:
            self.gpu.said.append("end")
            if not self.gpu.ends:
                raise RuntimeError("the capture is invalid")

        def replay(self) -> None:
            self.gpu.said.append(f"replay {self.number}")


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Stand:
    stand = Stand()
    names = ("CUDAGraph", "Stream", "current_stream", "synchronize", "graph_pool_handle", "stream")
    for name in names:
        monkeypatch.setattr(torch.cuda, name, getattr(stand, name))
    return stand


def test_work_is_recorded_aside_and_replayed(gpu: Stand) -> None:
    def work() -> str:
        gpu.said.append("work")
        assert not gc.isenabled()
        return "made"

    recorder = Recorder()
    first, second = recorder.record(work), recorder.record(work)
    assert gpu.said == ["aside", "begin", "work", "end", "back"] * 2
    assert gc.isenabled() and first.made == second.made == "made"
    first.replay()
    assert gpu.said[-1] == "replay 1"
    assert recorder._latest is second.graph  # which keeps their memory


@pytest.mark.parametrize("ends", [True, False])
def test_work_that_fails_ends_the_recording_and_says_why(gpu: Stand, ends: bool) -> None:
    gpu.ends = ends

    def work() -> Any:
        raise ValueError("it waits")

    with pytest.raises(ValueError, match="it waits"):
        Recorder().record(work)
    assert gpu.said[:3] == ["aside", "begin", "end"] and gc.isenabled()


def test_a_recording_that_does_not_end_is_an_error(gpu: Stand) -> None:
    gpu.ends = False
    with pytest.raises(RuntimeError, match="invalid"):
        Recorder().record(lambda: None)
    assert gc.isenabled()
