"""What each stage does, in the words that the terminal and the report use."""

DOING = {
    "ingest": "reading the photos",
    "sfm": "finding the cameras",
    "gate": "checking the cameras",
    "lighting": "looking at how the light moves",
    "masks": "finding the object in the photos",
    "start": "finding a first shape",
    "train": "learning shape and reflections",
    "shape": "making a surface of what was learned",
    "refine": "refining shape and reflections",
    "extract": "making a mesh",
    "clean": "cleaning the mesh",
    "fit": "fitting the mesh to the photos",
    "appearance": "telling material from light",
    "unwrap": "unfolding the mesh for textures",
    "bake": "painting the textures",
    "export": "writing the files",
    "evaluate": "comparing the result with the photos",
    "report": "drawing the report",
    "check": "looking at the photos",
}


def doing(stage: str) -> str:
    """What a stage does: "finding the cameras". A stage without an entry is only "running"."""
    return DOING.get(stage, "running")
