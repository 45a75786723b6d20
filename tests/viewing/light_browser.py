"""A browser without a screen: says where it looks, and takes what a viser server sends."""

import time
from typing import Any

import numpy as np


class LightBrowser:
    """A connection as viser's page makes it.

    Args:
        look_at, eye: (3,) where it looks, and from where, world units.
    """

    def __init__(self, port: int, *, look_at: np.ndarray, eye: np.ndarray) -> None:
        import viser
        from websockets.sync.client import connect

        self.connection = connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            origin=f"http://127.0.0.1:{port}",  # type: ignore[arg-type]
            max_size=None,
        )
        self.messages: list[dict[str, Any]] = []
        self.look(look_at=look_at, eye=eye)

    def look(self, *, look_at: np.ndarray, eye: np.ndarray) -> None:
        """Look from somewhere."""
        import msgspec
        from scipy.spatial.transform import Rotation

        ahead = (look_at - eye) / np.linalg.norm(look_at - eye)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        message = {
            "type": "ViewerCameraMessage",
            "wxyz": Rotation.from_matrix(turn).as_quat(scalar_first=True).tolist(),
            "position": eye.tolist(),
            "fov": 0.8,
            "near": 0.01,
            "far": 1000.0,
            "image_height": 300,
            "image_width": 400,
            "look_at": look_at.tolist(),
            "up_direction": [0.0, 0.0, 1.0],
        }
        self.connection.send(msgspec.msgpack.encode(message))

    def listen(self, seconds: float) -> None:
        """Take what comes in some seconds."""
        import msgspec
        import zstandard

        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                raw = self.connection.recv(timeout=left)
            except TimeoutError:
                return
            assert isinstance(raw, bytes)
            length = int.from_bytes(raw[8:16], "little")
            text = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length])
            self.messages += msgspec.msgpack.decode(text)["messages"]

    def until(self, *kinds: str, patience_s: float) -> None:
        """Take what comes until each kind of message has come."""
        end = time.monotonic() + patience_s
        while not set(kinds) <= self.kinds:
            assert time.monotonic() < end, set(kinds) - self.kinds
            self.listen(0.2)

    @property
    def kinds(self) -> set[str]:
        """The types of all messages so far."""
        return {message["type"] for message in self.messages}

    def close(self) -> None:
        """Go away."""
        self.connection.close()
