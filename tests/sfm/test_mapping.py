"""Reconstructions with some of their photos."""

from refdgs_pipe.child_process import call_in_child


def left_of_a_model() -> dict[str, list[str] | int]:
    """In a process of its own, as pycolmap is only loaded there."""
    import cv2  # noqa: F401  before pycolmap
    import pycolmap

    from refdgs_pipe.sfm.mapping import only

    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_points3D = 6, 50
    model = pycolmap.synthesize_dataset(options)
    names = sorted(model.image(i).name for i in model.reg_image_ids())
    copy = only(model, names[1:])
    gone = next(image for image in copy.images.values() if image.name == names[0])
    return {
        "before": sorted(model.image(i).name for i in model.reg_image_ids()),
        "all": names,
        "after": sorted(copy.image(i).name for i in copy.reg_image_ids()),
        "seen": sum(point.has_point3D() for point in gone.points2D),
        "points": copy.num_points3D(),
    }


def test_a_photo_that_is_left_out_takes_its_sights_along() -> None:
    found = call_in_child("sfm.test_mapping:left_of_a_model", {})
    assert found["before"] == found["all"]  # the model itself is unchanged
    assert found["after"] == found["all"][1:]
    assert found["seen"] == 0
    assert found["points"] > 0


def model_that_mapping_goes_on_from() -> bool:
    """Whether it is the mapper's own, where the refined one has another lens."""
    from unittest.mock import patch

    import cv2  # noqa: F401  before pycolmap
    import pycolmap

    from refdgs_pipe.sfm import colmap

    own, refined = pycolmap.Reconstruction(), pycolmap.Reconstruction()
    solver = colmap._Solver(*[None] * 5)  # type: ignore[arg-type]
    with (
        patch.object(colmap.mapping, "refined", lambda _: refined),
        patch.object(colmap, "poses_of", lambda model, *_: model),
    ):
        found = solver._found(own, None, None)  # type: ignore[arg-type]
    return found.model is own and found.poses is refined


def test_mapping_goes_on_with_the_lens_that_the_database_has() -> None:
    assert call_in_child("sfm.test_mapping:model_that_mapping_goes_on_from", {})
