"""Work of a GPU recorded once and done again in one launch."""

import gc
from collections.abc import Callable
from typing import Generic, TypeVar

import torch

Made = TypeVar("Made")


class Recorded(Generic[Made]):
    """Recorded work, and what it makes: the same memory every time it is done again."""

    def __init__(self, graph: torch.cuda.CUDAGraph, made: Made) -> None:
        self.graph, self.made = graph, made

    def replay(self) -> None:
        """Put the work on torch's current stream."""
        self.graph.replay()


class Recorder:
    """Records work by stream capture. All recordings take memory from one pool.

    They must be replayed one after the other, on one stream, and what one makes be used before the
    next is replayed. Memory that work only needs in between is shared among them.
    """

    def __init__(self) -> None:
        self._stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        self._pool = torch.cuda.graph_pool_handle()
        self._latest: torch.cuda.CUDAGraph | None = None  # without one the pool would go

    def record(self, work: Callable[[], Made]) -> Recorded[Made]:
        """Record what `work` asks of the GPU, which does none of it now.

        What is recorded reads and writes the addresses of now: those tensors must stay. The same
        work must have been done before, so that nothing is set up now.

        Raises:
            RuntimeError: it waits for the GPU, or asks for something else that cannot be recorded.
        """
        graph = torch.cuda.CUDAGraph()
        torch.cuda.synchronize()
        self._stream.wait_stream(torch.cuda.current_stream())
        collects = gc.isenabled()
        gc.disable()  # what it frees could wait for the GPU
        try:
            with torch.cuda.stream(self._stream):
                # other threads of the process may do as they like
                graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
                try:
                    made = work()
                except BaseException:
                    self._abandon(graph)
                    raise
                graph.capture_end()
        finally:
            if collects:
                gc.enable()
        torch.cuda.current_stream().wait_stream(self._stream)
        self._latest = graph
        return Recorded(graph, made)

    @staticmethod
    def _abandon(graph: torch.cuda.CUDAGraph) -> None:
        """End a capture that has failed; that it did is known."""
        try:
            graph.capture_end()
        except RuntimeError:
            torch.cuda.synchronize()
