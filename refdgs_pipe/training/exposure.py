"""How much brighter or darker each photo was taken than the others."""

import torch
from torch import Tensor


class Exposures:
    """One factor for each photo, on its sRGB values; 1 at the start.

    A camera that exposes by itself multiplies linear light by a factor. sRGB is nearly a power of
    that, so one factor on sRGB stands for it, but for the shadows and what the photo clips.

    Args:
        count: photos.
        rate: Adam's step of the factors' logarithms.
    """

    def __init__(self, count: int, rate: float, device: str) -> None:
        self.logs = torch.zeros(count, device=device, requires_grad=True)
        self.optimizer = torch.optim.Adam([self.logs], lr=rate, eps=1e-15, fused=True)

    def factor(self, which: Tensor) -> Tensor:
        """() the factor of a photo, given by (count,) 1 at its place and 0 elsewhere."""
        return torch.exp((self.logs * which).sum())

    def strangeness(self, which: Tensor) -> Tensor:
        """() the squared logarithm of that factor."""
        return (self.logs * which).sum().square()

    def state(self) -> dict[str, Tensor]:
        """Everything needed to continue."""
        moments = self.optimizer.state.get(self.logs, {})
        return {"logs": self.logs.detach(), **{f"adam.{k}": v for k, v in moments.items()}}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        device = self.logs.device
        with torch.no_grad():
            self.logs.copy_(state["logs"])
        named = {k.removeprefix("adam."): v for k, v in state.items() if k != "logs"}
        moments = {name: value.to(device, copy=True) for name, value in named.items()}
        if moments:
            self.optimizer.state[self.logs] = moments
