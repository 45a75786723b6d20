"""Settings of the stage `evaluate`."""

from pydantic import Field

from refdgs_pipe.params import Params


class EvaluateParams(Params):
    """How the result is scored."""

    max_side: int = Field(
        800, ge=32, le=8192, description="longest side of the pictures compared, in pixels"
    )
    lpips_weights: str = Field(
        "", max_length=4096, description="path of LPIPS's network as safetensors; empty: no LPIPS"
    )
    lpips_digest: str = Field("", max_length=64, description="hash of that file; `eval` sets it")
