"""Differentiable operations on surfels and maps. Each has a float64 torch reference that defines it."""

from refdgs_pipe.ops.rasterize import Maps, Pinhole, ScreenStatistics, Surfels, rasterize

__all__ = ["Maps", "Pinhole", "ScreenStatistics", "Surfels", "rasterize"]
