"""What a result shows of its own quality, measured on the object alone and without any truth."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ObjectFigures:
    """Figures that say how far to trust a result. None: there was nothing to measure it by.

    PSNRs are in dB over the object's pixels of sRGB-encoded pictures, means over views.

    Args:
        photos: usable ones; placed: those of them with a trusted place.
        masked: whether masks said where the object is; else the result's own outlines did.
        held_out: whether `psnr`, `asset_psnr`, `outline` and `depth` are of held-out photos.
        psnr: of the trained field; training_psnr: the same of photos that it was trained with.
        asset_psnr: of the textured mesh, drawn in the light that was found.
        outline: how far the mesh's outlines lie off those of the masks (of the field without
            masks), in percent of the object's size in the picture.
        depth: how far the mesh lies off the depth that each view sees of the field, in percent of
            the mesh's diagonal.
        contradicted: share of the places that one view sees where another view sees through, or
            sees something behind.
        unexplained: share of the surface where photos agree neither on its colour nor on what it
            would mirror.
        seen: share of the surface whose shape photos tell well; unseen: that none saw.
        holes: open rims without a single one round the bottom; hole_length: theirs, in diagonals.
        parts: loose pieces that are smaller than a twentieth of the surface; part_share: their
            share of the surface.
        floats: how far above the ground the mesh ends, in diagonals of the mesh; None where nothing
            says that it has to reach the ground.
        hanging: share of the surface in large pieces that nothing holds; None as for `floats`.
        lowest: height of the lowest photo over the horizon through the object, degrees; None where
            photos do not go round it.
        metres: whether the size is known.
    """

    photos: int = 0
    placed: int = 0
    masked: bool = False
    held_out: bool = True
    psnr: float | None = None
    training_psnr: float | None = None
    asset_psnr: float | None = None
    outline: float | None = None
    depth: float | None = None
    contradicted: float | None = None
    unexplained: float | None = None
    seen: float | None = None
    unseen: float | None = None
    holes: int = 0
    hole_length: float = 0.0
    parts: int = 0
    part_share: float = 0.0
    floats: float | None = None
    hanging: float | None = None
    lowest: float | None = None
    metres: bool = False
