"""Masks by a network of the user's: what goes in, what comes out, and what is refused."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import looking
from PIL import Image

pytest.importorskip("onnx", reason="onnx builds the networks of these tests: pip install onnx")
pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")

import networks
import onnx
from networks import BRIGHT, HALF, MEAN, brighter_than, constant, steps, whole, written
from onnx import TensorProto, helper
from stage_runs import Run

from refdgs_pipe.artifacts.lighting import WORLD
from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.child_process import ChildCrashed
from refdgs_pipe.errors import Cancelled, InputError
from refdgs_pipe.files.images import read_png
from refdgs_pipe.masking import by_network, onnx_file
from refdgs_pipe.masking.by_network import check_network, network_masks
from refdgs_pipe.masking.network import Model, Network, probabilities
from refdgs_pipe.masking.onnx_file import digest_of
from refdgs_pipe.masking.settings import MasksParams

SIZE = (160, 128)  # multiples of 32: a network of any size gets the photos as they are
COUNT, RADIUS = 8, 0.5
Capture = tuple[Views, SparseModel, list[np.ndarray]]


def camera(i: int) -> Camera:
    around = 2 * np.pi * i / COUNT
    eye = 3.0 * np.array([np.cos(around), np.sin(around), 0.5 * (i % 2)])
    K = np.array([[150.0, 0, SIZE[0] / 2], [0, 150.0, SIZE[1] / 2], [0, 0, 1]])
    return Camera(f"IMG_{i}", *SIZE, K, looking(eye))


def ball_in(one: Camera) -> np.ndarray:
    """(H, W) where a camera sees a ball at the origin, which stands on nothing."""
    rays = one.pixel_rays().reshape(-1, 3) @ one.cam_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    off = one.center - rays * (rays @ one.center)[:, None]
    return (np.linalg.norm(off, axis=1) < RADIUS).reshape(SIZE[::-1])


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Photos of a bright ball in the dark, with no points at all, and their true masks."""
    cameras = tuple(camera(i) for i in range(COUNT))
    truth = [ball_in(one) for one in cameras]
    for one, mask in zip(cameras, truth, strict=True):
        draw(tmp_path / f"{one.name}.png", mask)
    items = tuple(
        View(c.name, f"{c.name}.png", *SIZE, None, "train", Exif(), 1.0, 0.5, None, f"{c.name}.jpg")
        for c in cameras
    )
    lens = Lens(cameras[0].K, np.zeros(8))
    nothing, up = np.zeros((0, 3)), np.array([0.0, 0.0, 1.0])
    colors, ball = np.zeros((0, 3), np.uint8), Ball(np.zeros(3), 1.0)
    lenses = {c.name: lens for c in cameras}
    model = SparseModel(
        cameras, lenses, nothing, colors, {}, ball, up, np.eye(4), metres_per_unit=None, lost=()
    )
    return Views(tmp_path, items, "srgb", "photo"), model, truth


def draw(path: Path, mask: np.ndarray) -> None:
    """A photo that is bright in a mask, of a colour whose mean is 0.8."""
    rgb = np.where(mask[..., None], [255, 204, 153], [30, 20, 10]).astype(np.uint8)
    Image.fromarray(rgb).save(path)


def network(path: Path, model: Any = None, feeds: str = "0..1") -> Network:
    if model is not None:
        written(path, model)
    return Network(path, digest_of(path.read_bytes()), feeds)


def silent(label: str, done: int, total: int | None) -> None:
    """No progress."""


def test_the_masks_are_what_the_network_says_and_need_no_plane(
    capture: Capture, tmp_path: Path
) -> None:
    views, model, truth = capture
    told = network_masks(views, model, network(tmp_path / "n.onnx", brighter_than(HALF)), silent)
    for mask, true in zip(told.masks, truth, strict=True):
        np.testing.assert_array_equal(mask, true.astype(np.float32))
    assert told.agreement > 0.9  # cells of 2 % of the ball
    assert told.warnings(0.9) == []


def test_the_stage_writes_them_and_says_who_made_them(capture: Capture, tmp_path: Path) -> None:
    views, model, truth = capture
    made = network(tmp_path / "mine.onnx", brighter_than(HALF))
    settings = {"model": str(made.file), "model_digest": made.digest, "model_input": "0..1"}
    run = Run(tmp_path)
    masks = run("masks", views, model, WORLD, **settings)
    assert (masks.kind, masks.names) == ("network", tuple(model.names))
    assert run.measured("masks")["network"] == "mine.onnx"
    for name, true in zip(masks.names, truth, strict=True):
        np.testing.assert_array_equal(read_png(masks.path(name)), 255 * true)
    assert run.warnings() == []
    own = run("masks", replace(views, background="masked"), model, WORLD, **settings)
    assert (own.kind, own.names) == ("given", ())
    assert "was not asked" in run.warnings()[0]
    assert run("masks", views, model, WORLD, find="off", **settings).kind == "none"


def fed(side: int = 32) -> np.ndarray:
    """(side, side, 3) a picture, dark on the left."""
    ramp = np.linspace(0, 1, side, dtype=np.float32)
    return np.ascontiguousarray(np.broadcast_to(ramp[None, :, None], (side, side, 3)))


@pytest.mark.parametrize(
    ("feeds", "first"),
    [("0..1", 1.0), ("-0.5..0.5", 0.5), ("-1..1", 1.0), ("imagenet", (1 - 0.485) / 0.229)],
)
def test_the_network_is_fed_as_the_setting_says(feeds: str, first: float, tmp_path: Path) -> None:
    red = steps(("Slice", "x a b c", "y"), holds=[whole("a", 0), whole("b", 1), whole("c", 1)])
    got = Model(network(tmp_path / "n.onnx", red, feeds)).answer(fed(), "a photo")
    assert got.shape == (32, 32)
    assert got[0, -1] == pytest.approx(first, rel=1e-6)


ONES = constant("minus", -1.0)
TWICE = (MEAN, ("Mul", "mean k", "object"), ("Neg", "object", "other"))


@pytest.mark.parametrize(
    ("model", "share"),
    [
        (brighter_than(HALF), lambda v: v > 0.5),
        (steps(MEAN, ("Squeeze", "mean a", "y"), out=(1, "H", "W"), holds=[whole("a", 0)]), None),
        (steps(MEAN, ("Squeeze", "mean a", "y"), out=("H", "W"), holds=[whole("a", 0, 1)]), None),
        (
            steps(MEAN, ("Mul", "mean k", "y"), holds=[constant("k", 9.0)]),
            lambda v: 1 / (1 + np.exp(-9 * v)),
        ),
        (
            steps(
                *TWICE,
                ("Concat", "other object", "y", {"axis": 1}),
                out=(1, 2, "H", "W"),
                holds=[constant("k", 9.0)],
            ),
            lambda v: 1 / (1 + np.exp(-18 * v)),
        ),
        (
            steps(
                MEAN,
                ("Sub", "one mean", "other"),
                ("Concat", "other mean", "y", {"axis": 1}),
                out=(1, 2, "H", "W"),
                holds=[constant("one", 1.0)],
            ),
            None,
        ),
        (steps(MEAN, ("Identity", "mean", "y"), ("Neg", "mean", "z"), besides=("z",)), None),
    ],
    ids=["one", "1hw", "hw", "logits", "two logits", "two shares", "several outputs"],
)
def test_each_kind_of_answer_becomes_a_probability(model: Any, share: Any, tmp_path: Path) -> None:
    got = Model(network(tmp_path / "n.onnx", model)).answer(fed(), "a photo")
    (plane,) = probabilities([got.astype(np.float16)])
    values = fed().mean(2)
    wanted = values if share is None else share(values)
    np.testing.assert_allclose(plane / 255, wanted, atol=3e-3)  # 8 bits, and float16 before


def test_a_network_of_a_fixed_size_gets_that_size(capture: Capture, tmp_path: Path) -> None:
    views, model, truth = capture
    fixed = brighter_than(HALF, sides=(64, 48), out=(1, 1, 64, 48))
    told = network_masks(views, model, network(tmp_path / "n.onnx", fixed), silent)
    for mask, true in zip(told.masks, truth, strict=True):
        assert mask.shape == true.shape
        both, either = ((mask > 0.5) & true).sum(), ((mask > 0.5) | true).sum()
        assert both / either > 0.9  # a pixel of the network is up to 3.3 of the photo


def test_a_photo_of_odd_sides_is_fed_at_multiples_of_32(tmp_path: Path) -> None:
    model = Model(network(tmp_path / "n.onnx", brighter_than(HALF)))
    assert model.size((150, 200)) == (160, 192)
    assert model.size((3000, 4000)) == (768, 1024)
    assert model.size((5, 4000)) == (32, 1024)


def test_the_second_answer_is_the_same_bit_for_bit(capture: Capture, tmp_path: Path) -> None:
    views, model, _ = capture
    made = network(tmp_path / "n.onnx", steps(MEAN, ("Sigmoid", "mean", "y")))
    one, other = (network_masks(views, model, made, silent) for _ in range(2))
    for a, b in zip(one.masks, other.masks, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_photo_without_an_object_gets_the_outline_that_the_others_show(
    capture: Capture, tmp_path: Path
) -> None:
    views, model, truth = capture
    draw(tmp_path / "IMG_3.png", np.zeros_like(truth[3]))
    told = network_masks(views, model, network(tmp_path / "n.onnx", brighter_than(HALF)), silent)
    (said,) = told.warnings(0.9)
    assert "1 of 8 photos (IMG_3.jpg)" in said
    filled = told.masks[3] > 0.5
    assert (filled & truth[3]).sum() / (filled | truth[3]).sum() > 0.85


def test_masks_that_fit_no_solid_are_a_warning_that_names_the_worst(
    capture: Capture, tmp_path: Path
) -> None:
    views, model, truth = capture
    draw(tmp_path / "IMG_5.png", np.roll(truth[5], 40, 1))
    made = network(tmp_path / "n.onnx", brighter_than(HALF))
    told = network_masks(views, model, made, silent)
    assert np.argmin(told.shares) == 5
    assert "IMG_5.jpg" in told.warnings(0.0)[0]
    for i in (0, 2, 4, 6):
        draw(tmp_path / f"IMG_{i}.png", np.roll(truth[i], 60, 1))
    told = network_masks(views, model, made, silent)
    assert told.agreement < 0.5
    assert "with one solid; 90.0% is expected" in told.warnings(0.9)[0]


def test_a_network_that_takes_all_for_the_object_is_a_warning(
    capture: Capture, tmp_path: Path
) -> None:
    views, model, _ = capture
    told = network_masks(views, model, network(tmp_path / "n.onnx", brighter_than(0.0)), silent)
    assert "takes 100% of the pictures" in told.warnings(0.9)[0]


def test_no_object_in_any_photo_is_an_error(capture: Capture, tmp_path: Path) -> None:
    views, model, _ = capture
    made = network(tmp_path / "n.onnx", brighter_than(2.0))
    with pytest.raises(InputError, match=r"no object in any of the 8 photos.*0\.00.*model_input"):
        network_masks(views, model, made, silent)


def outside(path: Path) -> Any:
    """A network whose level lies in another file."""
    model = brighter_than(HALF)
    (level,) = model.graph.initializer
    level.ClearField("float_data")
    level.data_location = TensorProto.EXTERNAL
    for key, value in (("location", str(path)), ("length", "4")):
        entry = level.external_data.add()
        entry.key, entry.value = key, value
    return model


def nested(model: Any) -> Any:
    """The same constant within a graph in an attribute."""
    level = model.graph.initializer[0]
    inner = helper.make_graph(
        [helper.make_node("Constant", [], ["v"], value=level)],
        "inner",
        [],
        [helper.make_tensor_value_info("v", TensorProto.FLOAT, [])],
    )
    model.graph.node.append(
        helper.make_node("If", ["is"], ["z"], then_branch=inner, else_branch=inner)
    )
    model.graph.initializer[0].CopyFrom(brighter_than(HALF).graph.initializer[0])
    return model


CUSTOM = steps(("Odd", "x", "y", {"domain": "my.ops"}), domains=[helper.make_opsetid("my.ops", 1)])
NAN = steps(MEAN, ("Log", "mean", "y"))
BOMB = steps(
    MEAN,
    ("Shape", "mean", "s"),
    ("Mul", "s a", "many"),
    ("ConstantOfShape", "many", "y"),
    out=None,
    holds=[whole("a", 1, 1, 3000, 3000)],
)


SMALL: Any = {"out": None, "holds": [whole("a", 20, 20)]}
AT_LAST = steps(MEAN, ("Shape", "x", "s"), ("Reshape", "x s", "y"), out=None)
HOLDS = {"holds": [constant("half", HALF)]}


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (CUSTOM, r"custom operators \(my\.ops\)"),
        (outside(Path("weights.bin")), "external data.*one file"),
        (nested(outside(Path("weights.bin"))), "external data"),
        (steps(("Nothing", "x", "y")), "cannot load this network.*Nothing"),
        (steps(*BRIGHT, shape=(1, "H", "W", 3), **HOLDS), r"\(1, 3, H, W\)"),
        (steps(*BRIGHT, sides=(8, 8), **HOLDS), "16 to 4096"),
        (steps(*BRIGHT, sides=(9000, 9000), **HOLDS), "16 to 4096"),
        (steps(MEAN, ("Add", "mean k", "y"), also=("k",)), "takes x.*, k .*One input"),
        (steps(MEAN, ("Cast", "mean", "y", {"to": 7}), gives=7), r"tensor\(int64\)"),
        (steps(("Identity", "x", "y"), out=(1, 3, "H", "W")), r"output is \(1, 3, any, any\)"),
        (steps(("GlobalAveragePool", "x", "g"), ("Flatten", "g", "y"), out=(1, 3)), r"is \(1, 3\)"),
        (AT_LAST, r"first output is \(1, 3, 32, 32\)\. "),
    ],
    ids=[
        *("custom", "external", "nested", "unknown", "nhwc", "tiny", "large", "two inputs"),
        *("integers", "three channels", "classes", "three channels at last"),
    ],
)
def test_a_network_that_cannot_be_used_is_refused(model: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words) as refused:
        Model(network(tmp_path / "bad.onnx", model)).answer(fed(), "a photo")
    assert str(refused.value).startswith(f"{tmp_path / 'bad.onnx'}: ")
    assert refused.value.exit_code == 64


def test_a_network_is_tried_before_it_is_needed(tmp_path: Path) -> None:
    check_network(network(tmp_path / "n.onnx", brighter_than(HALF)))
    with pytest.raises(InputError, match="fails on a grey picture"):
        check_network(network(tmp_path / "n.onnx", steps(("Reshape", "x a", "y"), **SMALL)))


def test_an_answer_that_no_memory_holds_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"fails on a grey picture.*lloc|the network was killed"):
        check_network(network(tmp_path / "n.onnx", BOMB))


def test_values_that_are_no_numbers_are_refused_with_the_photo(tmp_path: Path) -> None:
    model = Model(network(tmp_path / "n.onnx", NAN))
    with pytest.raises(InputError, match=r"of 1024 values that it gives for a\.jpg"):
        model.answer(fed(), "a.jpg")


@pytest.mark.parametrize("data", [b"", b"hello world", b"ORTM" * 40, b"\x80\x02}q.", b"\x3a\x7f"])
def test_what_is_no_onnx_file_is_refused(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "n.onnx").write_bytes(data)
    with pytest.raises(InputError, match="not an ONNX model"):
        Model(network(tmp_path / "n.onnx"))


def test_a_damaged_file_is_refused_wherever_it_is_cut(tmp_path: Path) -> None:
    good = brighter_than(HALF).SerializeToString()
    for length in range(1, len(good), 7):
        (tmp_path / "n.onnx").write_bytes(good[:length])
        with pytest.raises(InputError):
            Model(network(tmp_path / "n.onnx"))


def test_an_external_tensor_is_seen_in_every_part_of_a_model() -> None:
    far = outside(Path("w")).graph.initializer[0]
    sparse = onnx.SparseTensorProto(values=far)
    graph = onnx.GraphProto(initializer=[far])
    attributes = [
        onnx.AttributeProto(name="a", t=far),
        onnx.AttributeProto(name="a", tensors=[far]),
        onnx.AttributeProto(name="a", g=graph),
        onnx.AttributeProto(name="a", graphs=[graph]),
        onnx.AttributeProto(name="a", sparse_tensor=sparse),
        onnx.AttributeProto(name="a", sparse_tensors=[sparse]),
    ]
    graphs = [onnx.GraphProto(node=[onnx.NodeProto(attribute=[one])]) for one in attributes]
    graphs += [graph, onnx.GraphProto(sparse_initializer=[sparse])]
    models = [onnx.ModelProto(graph=one) for one in graphs]
    node = graphs[0].node[0]
    plain = onnx.GraphProto(name="g")
    models.append(onnx.ModelProto(graph=plain, functions=[onnx.FunctionProto(node=[node])]))
    training = onnx.TrainingInfoProto(algorithm=graph)
    models.append(onnx.ModelProto(graph=plain, training_info=[training]))
    for model in models:
        with pytest.raises(InputError, match="external data"):
            onnx_file.check_content(model.SerializeToString(), "a")


def test_a_file_that_is_gone_large_or_changed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = network(tmp_path / "n.onnx", brighter_than(HALF))
    with pytest.raises(InputError, match="changed after the run began"):
        Model(replace(made, digest="0" * 32))
    with pytest.raises(InputError, match="no such file"):
        Model(replace(made, file=tmp_path))
    monkeypatch.setattr(onnx_file, "MOST_BYTES", 100)
    with pytest.raises(InputError, match="all of it in one file"):
        Model(made)


def test_without_onnxruntime_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(
        InputError, match=r"`pip install onnxruntime`; .* extra mask-model"
    ) as refused:
        Model(network(tmp_path / "n.onnx", brighter_than(HALF)))
    assert refused.value.exit_code == 64


@pytest.mark.parametrize(
    ("cause", "words"),
    [("crashed (SIGSEGV)", "network crashed"), ("crashed (SIGALRM)", "took more than 600 s")],
)
def test_a_crash_is_an_error_that_names_the_network(
    cause: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crash(target: str, *_: object, **__: object) -> None:
        raise ChildCrashed(f"{target} {cause}\nlines of a log")

    monkeypatch.setattr(by_network, "call_in_child", crash)
    with pytest.raises(InputError, match=words):
        check_network(network(tmp_path / "n.onnx", brighter_than(HALF)))


def test_a_run_can_be_stopped_between_photos(capture: Capture, tmp_path: Path) -> None:
    views, model, _ = capture

    def stop(label: str, done: int, total: int | None) -> None:
        raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        network_masks(views, model, network(tmp_path / "n.onnx", brighter_than(HALF)), stop)


def test_keys_know_the_network_by_its_content_alone() -> None:
    here = MasksParams(model="/here/a.onnx", model_digest="1")
    assert MasksParams().hashed() == [
        {"find": "auto", "agreement": 0.87}
    ]  # as before there were any
    assert MasksParams(model_digest="1", model_input="0..1").hashed() == MasksParams().hashed()
    assert here.hashed() == MasksParams(model="/there/b.onnx", model_digest="1").hashed()
    assert here.hashed() != MasksParams(model="/here/a.onnx", model_digest="2").hashed()
    fed_else = MasksParams(model="/here/a.onnx", model_digest="1", model_input="0..1")
    assert here.hashed() != fed_else.hashed()
    assert "onnxruntime" in here.hashed()[0]


def test_the_networks_of_these_tests_are_sound() -> None:
    onnx.checker.check_model(networks.brighter_than(HALF))
