"""Settings of the stage `masks`."""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from refdgs_pipe.params import Params


class MasksParams(Params):
    """Masks that are made from the photos themselves."""

    find: Literal["auto", "off"] = Field(
        "auto", description="auto: find masks for photos that have none; off: do not"
    )
    agreement: float = Field(
        0.87,
        ge=0,
        le=1,
        description="least agreement of found masks with the one solid that all of them show "
        "(intersection over union). Below it found masks are not used; a network's masks are used "
        "with a warning",
    )
    model: str = Field(
        "",
        max_length=4096,
        description="absolute path of your own segmentation network, an ONNX file; empty: none",
    )
    model_digest: str = Field("", max_length=64, description="hash of that file; a run sets it")
    model_input: Literal["imagenet", "0..1", "-0.5..0.5", "-1..1"] = Field(
        "imagenet",
        description="input of the network. imagenet: RGB in [0, 1], normalised by ImageNet's mean "
        "and standard deviation; otherwise RGB scaled to this range",
    )

    @field_validator("model")
    @classmethod
    def _absolute(cls, path: str) -> str:
        if path and not Path(path).is_absolute():
            raise ValueError("an absolute path; `run --mask-model FILE` takes any")
        return path

    @property
    def network(self) -> str:
        """The file name of the network."""
        return Path(self.model).name

    def hashed(self) -> list[dict[str, Any]]:
        """The settings as keys hold them: the network by its content, and only if there is one."""
        network = {
            "model": self.model_digest,
            "model_input": self.model_input,
            "onnxruntime": _runtime(),
        }
        return [
            {name: value for name, value in plain.items() if not name.startswith("model")}
            | (network if self.model else {})
            for plain in super().hashed()
        ]


def _runtime() -> str:
    """The version of onnxruntime: a stage's `programs` would be in keys without a network too."""
    try:
        return version("onnxruntime")
    except PackageNotFoundError:
        return "not installed"
