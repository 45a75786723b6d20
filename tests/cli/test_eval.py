"""What `eval` prints."""

import json
from pathlib import Path

import pytest

from refdgs_pipe.artifacts.scores import MaterialScore, PartScore, Scores, SurfaceScore, ViewScore
from refdgs_pipe.cli.evaluation import describe, open_for_scores
from refdgs_pipe.errors import InputError
from refdgs_pipe.evaluation.lpips import digest_of

VIEWS = (
    ViewScore("a", 30.0, 30.5, 0.95, None, 1.0, 3.0, 0.01, 0.99, 27.0, 26.0, 23.0),
    ViewScore("b", 32.0, 32.5, 0.97, None, 2.0, 5.0, 0.03, 0.97, 28.0, 27.0, 24.0),
)
SURFACE = SurfaceScore(2.0, 0.0062, 0.005, 0.004, 0.006, 0.9, 1.0, 0.003, 0.002, 0.02, 0.03)
PART = PartScore("lid", 900, 0.25, 0.2, 0.06, 0.9, 1.0, 0.85)
MATERIALS = MaterialScore(0.08, 0.9, 0.85, (PART,))
SURFELS = {"geometry": 20000, "local": 900, "background": 0}
NO_WEIGHTS = {"lpips": "no weights given (--lpips-weights)"}


SCORES = Scores("test", VIEWS, SURFACE, SURFELS, NO_WEIGHTS, MATERIALS)


def record(scores: Scores) -> dict[str, object]:
    return {
        "workspace": "work",
        "scores": scores.record(),
        "speed": {"views_per_second": 9.5, "rendered": "320 x 320 on cpu, threads: 2"},
        "seconds": {"train": 372.0, "evaluate": 12.0},
    }


def test_the_table_names_each_figure_its_unit_and_its_protocol() -> None:
    lines = describe(record(SCORES)).splitlines()
    assert [" ".join(line.split()) for line in lines] == [
        "views 2 held-out",
        "PSNR 31.00 dB over white, all channels at once",
        "PSNR by channel 31.50 dB the paper's: mean of the channels' own",
        "SSIM 0.9600",
        "LPIPS not computed: no weights given (--lpips-weights)",
        "normal error 1.50 degrees the paper's: all pixels, over white",
        "normal error 4.00 degrees the object's pixels",
        "depth error 0.02000 units where both have a surface",
        "alpha IoU 0.9800",
        "PSNR, relit 27.50 dB of the textured mesh in its own light",
        "PSNR, object 26.50 dB the object's pixels",
        "of it, relit 23.50 dB the same of the textured mesh",
        "Chamfer distance 0.00620 units 0.310 % of the diagonal; the paper's: points seen",
        "Chamfer distance 0.00500 units 0.250 % of the diagonal; between the surfaces, where seen",
        "mesh to truth 0.00400 units 0.200 % of the diagonal; accuracy",
        "truth to mesh 0.00600 units 0.300 % of the diagonal; completeness",
        "mesh to truth 0.00300 units 0.150 % of the diagonal; median",
        "truth to mesh 0.00200 units 0.100 % of the diagonal; median",
        "mesh to truth 0.02000 units 1.000 % of the diagonal; in the worst part",
        "truth to mesh 0.03000 units 1.500 % of the diagonal; in the worst part",
        "F-score 0.9000 share within 0.5 % of the diagonal",
        "F-score 1.0000 share within 1 % of the diagonal",
        "base colour 0.0800 linear, scale-invariant RMSE",
        "roughness order 0.900 rank correlation over the materials",
        "metal 0.850 share of the texels told right",
        "lid roughness 0.25 truth 0.20, error 0.06; metal 85% right, truth 1",
        "render rate 9.50 views/s 320 x 320 on cpu, threads: 2",
        "surfels 20000 geometry, 900 local, 0 background",
        "train took 6 min 12 s",
        "evaluate took 12 s",
    ]
    remarks = ((1, "over"), (5, "the paper"), (12, "0.310"), (26, "320"))
    assert len({lines[row].index(words) for row, words in remarks}) == 1


def test_what_is_missing_is_said_and_not_left_blank() -> None:
    views = (ViewScore("a", 30.0, 30.5, 0.95),)
    notes = {"surface": "no gt_mesh.ply in the data set", "depth_mae": "no NAME_depth.npz"}
    text = describe(record(Scores("train", views, None, SURFELS, notes)))
    assert "1 training (none was held out)" in text
    assert "depth error       not computed: no NAME_depth.npz" in text
    assert "Chamfer distance  not computed: no gt_mesh.ply in the data set" in text


def test_weights_are_remembered_with_their_hash_and_replace_older_ones(tmp_path: Path) -> None:
    work, weights = tmp_path / "work", tmp_path / "my weights.safetensors"
    work.mkdir()
    weights.write_bytes(b"1")
    old = ["train.iterations=5", 'evaluate.lpips_weights="/old"', 'evaluate.lpips_digest="0"']
    memory = {"photos": [["photos", "/photos"]], "recipe": "glossy", "set": old}
    (work / "workspace.json").write_text(json.dumps(memory))
    space = open_for_scores(work, weights)
    assert space.memory.assignments == (
        "train.iterations=5",
        f'evaluate.lpips_weights="{weights}"',
        f'evaluate.lpips_digest="{digest_of(weights)}"',
    )
    assert open_for_scores(work, None).memory.assignments == tuple(old)
    with pytest.raises(InputError, match="cannot be read"):
        open_for_scores(work, tmp_path / "gone")
