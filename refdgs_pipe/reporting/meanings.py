"""What the figures of the report mean, each in one line."""

SCORES = {
    "psnr": "likeness of the pictures; 20 is rough, 30 is hard to tell from the photo",
    "psnr_per_channel": "the same, for red, green and blue on their own; as papers have it",
    "ssim": "likeness of structure; 1 is the same picture",
    "lpips": "difference as a network trained on people's judgement sees it; 0 is none",
    "normal_mae_deg": "how far the surface is turned from the truth, in the whole picture",
    "normal_mae_foreground_deg": "how far the surface is turned from the truth, on the object",
    "depth_mae": "how far the surface lies from the truth, seen from the camera",
    "alpha_iou": "how well the outlines agree; 1 is the same outline",
    "relit_psnr": "likeness of the exported asset, drawn in the light that was found",
    "object_psnr": "likeness on the object alone, without the background",
    "relit_object_psnr": "the same, of the exported asset",
}
SURFACE = "distance between the mesh and the true surface, in percent of the diagonal of its box"
F_SCORE = "share of the surface that lies closer to the truth than this"
LEFT_OUT = "share of the mesh that lies too far from the truth to count, such as a table"
CONFIDENCE = "rank correlation of low confidence and large distance from the truth; 1 is best"
MATERIALS = {
    "base colour": "mean error of the colour; 0 is none",
    "roughness order": "whether rougher parts are rougher; 1 is the right order",
    "metal told right": "share of the texture where metal and not metal are right",
}
MEASURES = {
    "photos": "photos that were read",
    "skipped": "files that were not used",
    "colour space": "of the photos",
    "background": "photo: nothing is masked; masked: masks came; removed: cut out",
    "registered": "photos whose cameras were found",
    "points": "points of the scene that the cameras were found by",
    "focal length": "of the camera",
    "ball centre": "middle of the ball that holds the object",
    "ball radius": "radius of the ball that holds the object",
    "reprojection error": "how far points lie from where photos show them; 1 or less is good",
    "mapper": "the way that cameras were put together",
    "poses refined on the ground plane": "cameras that were placed again by the ground's picture",
    "distance from the ground's texture": "before and after the cameras were placed again",
    "agreement of the masks": "how well the masks of all photos fit one solid; 1 is fully",
    "agreement, worst tenth": "the same, of the worst tenth of the photos",
    "masks": "why there are none",
    "network": "the network that made the masks",
    "object shown": "share of the object's ball that the photos show",
    "device": "what made it; a CPU and a GPU give slightly different results",
    "steps": "steps of training",
    "loss": "what training makes small",
    "train PSNR": "likeness to the photos of the training",
    "surfels": "small discs that the surface is made of while it is learned",
    "near-field features": "likeness to held-out photos with near reflections, and without",
    "local surfels": "discs that hold reflections of near things",
    "background surfels": "discs of what is behind the object",
    "views fused": "views that the mesh was made of",
    "voxel": "size of the smallest detail of the first mesh",
    "faces": "triangles",
    "floaters removed": "loose pieces that were taken away",
    "floaters' share of the area": "how much of the surface they were",
    "open rims": "edges where the surface ends",
    "open area": "area of the holes",
    "parts made flat": "parts that are flat and were made exactly so",
    "mean light": "brightness of the light that was found",
    "metal": "share of the surface that is metal",
    "program": "that cut the surface into pieces for the textures",
    "charts": "pieces that the surface is cut into for the textures",
    "atlas used": "share of the texture that the pieces fill",
    "stretch": "how much the texture is stretched; 1 is not at all",
    "texture size": "side of the textures",
    "texels seen": "share of the texture that photos show",
    "size": "longest side of the asset, and what tells it",
    "asset.glb": "size of the file",
    "asset.usdz": "size of the file",
    "PSNR of held-out views": "likeness to photos that were not used for learning",
    "SSIM of held-out views": "likeness of structure to these photos",
    "PSNR of the relit asset": "likeness of the exported asset to these photos",
    "render rate": "how fast the learned model draws",
    "rendered": "size and machine of that",
}
STAGE = "what the stage measured"


def measured(name: str) -> str:
    """What a figure of a stage means; empty where its name says it."""
    return MEASURES.get(name, "")
