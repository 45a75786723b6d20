"""Laws of recipes: what they may say, what wins, and how mistakes are answered."""

import re
from pathlib import Path
from typing import Any

import pytest
from fake_stages import STAGES, ShoutParams

from refdgs_pipe import recipe
from refdgs_pipe.errors import InputError
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.catalog import load_stages

MODELS = {stage.name: stage.params for stage in STAGES}


def write(folder: Path, name: str, text: str) -> str:
    path = folder / f"{name}.toml"
    path.write_text(text)
    return str(path)


def resolve(name: str, *assignments: str) -> dict[str, Params]:
    return recipe.resolve(recipe.load(name), assignments, MODELS)


def shout(settings: dict[str, Params]) -> ShoutParams:
    found = settings["shout"]
    assert isinstance(found, ShoutParams)
    return found


def test_the_command_line_wins_over_the_recipe_and_that_over_the_default(tmp_path: Path) -> None:
    name = write(tmp_path, "mine", "[shout]\nmarks = 4\nmood = 'glad'\n")
    assert shout(resolve(name)) == ShoutParams(marks=4, mood="glad")
    assert shout(resolve(name, "shout.marks=5")) == ShoutParams(marks=5, mood="glad")
    assert shout(resolve(name, "shout.marks=5", "shout.marks=6")).marks == 6


def test_a_recipe_builds_on_another_beside_it_or_on_a_known_one(tmp_path: Path) -> None:
    write(tmp_path, "base", "[shout]\nmarks = 4\nmood = 'glad'\n")
    name = write(tmp_path, "mine", "extends = 'base.toml'\n[shout]\nmarks = 7\n")
    assert shout(resolve(name)) == ShoutParams(marks=7, mood="glad")
    assert shout(resolve(write(tmp_path, "other", "extends = 'glossy'\n"))) == ShoutParams()


def test_a_recipe_that_extends_a_draft_is_one_unless_it_says_otherwise(tmp_path: Path) -> None:
    texts = ("extends = 'preview'\n", "extends = 'preview'\ndraft = false\n", "draft = true\n", "")
    drafts = [recipe.load(write(tmp_path, f"r{i}", text)).draft for i, text in enumerate(texts)]
    assert drafts == [True, False, True, False]


@pytest.mark.parametrize(
    ("text", "value"), [("2", 2), (" 3 ", 3), ("'4'", 4)], ids=["number", "spaces", "quoted"]
)
def test_values_on_the_command_line_are_read_kindly(text: str, value: Any) -> None:
    assert shout(resolve("glossy", f"shout.marks={text}")).marks == value


def test_words_need_no_quotes_on_the_command_line() -> None:
    assert shout(resolve("glossy", "shout.mood=very glad")).mood == "very glad"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("marks = 3", "marks stands outside a table. Put it under a [stage]"),
        ("[shout\n", "not TOML"),
        ("draft = 3", "draft = 3: expected true or false"),
        ("extends = 3", "extends = 3: expected the name of a recipe"),
        ("extends = 'mine.toml'", "extends itself"),
        ("extends = 'glosy'", "no recipe is called 'glosy'. Did you mean glossy?"),
        ("[shuot]\nmarks = 1", "no stage is called 'shuot'. Did you mean shout?"),
        ("[shout]\nmraks = 1", "shout has no setting 'mraks'. Did you mean shout.marks?"),
        ("[shout]\nmarks = 'a lot'", 'shout.marks = "a lot": expected a valid integer'),
        ("[shout]\nmarks = 10", "shout.marks = 10: expected less than or equal to 9"),
    ],
)
def test_mistakes_are_named_with_their_place(tmp_path: Path, text: str, words: str) -> None:
    name = write(tmp_path, "mine", text)
    with pytest.raises(InputError) as caught:
        resolve(name)
    assert words in str(caught.value)
    if "glosy" not in words:
        assert name in str(caught.value)


def test_train_cuda_graph_is_an_option_now_and_keys_still_hold_it() -> None:
    said: list[str] = []
    models = {stage.name: stage.params for stage in load_stages()}
    found, text = recipe.load("glossy"), "train.cuda_graph=off"
    settings = recipe.resolve(found, [text], models, tell=said.append)
    assert said == [
        f"--set {text}: train.cuda_graph is now the option --cuda-graph, and is ignored here"
    ]
    hashed = settings["train"].hashed()
    assert [params["cuda_graph"] for params in hashed] == ["auto", "on", "off"]
    assert recipe.up_to_date([text, "start.seed=1"], models) == ("start.seed=1",)


def test_an_old_name_of_a_setting_means_the_new_one_and_the_user_is_told(tmp_path: Path) -> None:
    models, said = {stage.name: stage.params for stage in load_stages()}, list[str]()
    name = write(tmp_path, "mine", "extends = 'preview'\n[train]\nlook_steps = 7\nseed = 2\n")
    given = ["train.surfels=300", "train.start=hull", "train.seed=4"]
    settings: Any = recipe.resolve(recipe.load(name), given, models, tell=said.append)
    assert settings["start"].look_steps == 7  # `preview` has start.look_steps = 600
    assert (settings["start"].surfels, settings["start"].masked) == (300, "hull")
    assert settings["start"].seed == 4
    assert f"{name}: train.look_steps is now start.look_steps" in said
    assert "--set train.start=hull: train.start is now start.masked" in said
    assert recipe.up_to_date(given, models) == (
        "start.surfels=300",
        "start.masked=hull",
        "start.seed=4",
    )
    shown = recipe.describe(settings, only=recipe.load(name))
    assert "\nlook_steps = 7\n" in shown.partition("[start]")[2].partition("[train]")[0]


def test_a_wrong_value_under_an_old_name_is_named_as_it_was_given() -> None:
    models = {stage.name: stage.params for stage in load_stages()}
    with pytest.raises(InputError, match=r"--set train.surfels=1: start.surfels = 1: expected"):
        recipe.resolve(recipe.load("glossy"), ["train.surfels=1"], models)


def test_every_old_name_leads_to_a_setting() -> None:
    models = {stage.name: stage.params for stage in load_stages()}
    for model in models.values():
        for today in model.renamed.values():
            stage, _, key = today.partition(".")
            assert key in models[stage].model_fields
        assert not model.renamed.keys() & model.model_fields.keys()


def test_ten_settings_are_shown_first_and_every_setting_is_in_one_group() -> None:
    models = {stage.name: stage.params for stage in load_stages()}
    settings = recipe.resolve(recipe.load("glossy"), ["train.iterations=7"], models)
    lines = recipe.basics(settings).splitlines()
    assert len(lines) == 10
    assert any(line.startswith("# train.iterations = 7 ") for line in lines)
    for model in models.values():
        names = [name for group in model.groups().values() for name in group]
        assert sorted(names) == sorted(model.model_fields)
    assert {"Schedule", "Surfels", "Light", "Losses", "Rates"} <= models["train"].groups().keys()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("train.environment_height=100", "expected a power of two, such as 64 or 128"),
        ("bake.size=1000", "expected a power of two, such as 512 or 1024"),
        ("ingest.holdout=1", "expected 0, for none, or at least 2: 1 leaves no photo to train on"),
        ("gate.up=[0, 0, 0]", "expected a direction, such as [0, 0, 1]"),
        ("gate.distance=a.jpg 0.23", "'a.jpg' is no mark in a photo"),
        ("train.rate_means=nan", "expected a finite number"),
        ("gate.ball_radius=inf", "expected a finite number"),
    ],
)
def test_values_that_cannot_work_are_refused_before_any_work(text: str, words: str) -> None:
    models = {stage.name: stage.params for stage in load_stages()}
    with pytest.raises(InputError, match=re.escape(words)):
        recipe.resolve(recipe.load("glossy"), [text], models)


def test_a_wrong_value_is_answered_with_the_meaning_limits_and_default() -> None:
    with pytest.raises(InputError) as caught:
        resolve("glossy", "shout.marks=10")
    assert str(caught.value) == (
        "--set shout.marks=10: shout.marks = 10: expected less than or equal to 9. "
        "marks: exclamation marks, a count (at least 0, at most 9, default 1)"
    )


@pytest.mark.parametrize("name", recipe.names())
def test_every_recipe_says_when_to_use_it_and_fits_the_stages(name: str) -> None:
    found = recipe.load(name)
    assert len(found.about) > 30
    models = {stage.name: stage.params for stage in load_stages()}
    settings = recipe.resolve(found, [], models)
    defaults = {stage: model() for stage, model in models.items()}
    for stage, table in found.tables.items():
        for key in table:
            differs = getattr(settings[stage], key) != getattr(defaults[stage], key)
            assert differs, f"{stage}.{key} in {name} is the default anyway"


def test_a_resolved_recipe_can_be_read_back(tmp_path: Path) -> None:
    settings = resolve("glossy", 'shout.mood="with "', "shout.marks=3")
    name = write(tmp_path, "whole", recipe.describe(settings))
    assert resolve(name) == settings
