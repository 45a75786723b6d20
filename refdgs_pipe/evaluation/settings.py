"""Settings of the stage `evaluate`."""

from pydantic import Field

from refdgs_pipe.params import Params


class EvaluateParams(Params):
    """How the result is scored."""

    max_side: int = Field(800, ge=32, le=8192, description="longest side compared, in pixels")
    lpips_weights: str = Field(
        "", max_length=4096, description="LPIPS's network in safetensors, a path; empty: none"
    )
    lpips_digest: str = Field("", max_length=64, description="hash of that file, as eval finds it")
