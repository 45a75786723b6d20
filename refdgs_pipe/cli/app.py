"""The command line. Thin: each command opens a workspace, calls one function and prints."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from refdgs_pipe import __version__, recipe
from refdgs_pipe.cli import completion, mask_model
from refdgs_pipe.cli import workspace as spaces
from refdgs_pipe.cli.batch.commands import batches
from refdgs_pipe.cli.cache import caches
from refdgs_pipe.cli.check import check_command
from refdgs_pipe.cli.companion import accompanied
from refdgs_pipe.cli.device import bytes_of, check_device, core_count
from refdgs_pipe.cli.doctor import doctor_command
from refdgs_pipe.cli.ending import end_with
from refdgs_pipe.cli.mat import mat_command
from refdgs_pipe.cli.options import (
    Assignments,
    Cache,
    CudaGraph,
    Device,
    DryRun,
    Folder,
    Force,
    From,
    Json,
    Quiet,
    RecipeArgument,
    RecipeName,
    Stage,
    Strict,
    Threads,
    Until,
    Verbose,
    Verify,
    View,
    Vram,
)
from refdgs_pipe.cli.running import Options, make, print_plan, shared_by, within
from refdgs_pipe.cli.status import status_command
from refdgs_pipe.cli.verify import make_sound
from refdgs_pipe.cli.view import view_command
from refdgs_pipe.documents import write_json_text
from refdgs_pipe.errors import InputError
from refdgs_pipe.formatting import aligned, printable, size

HELP = "Make a textured GLB and USDZ from photos of a glossy object."

HELP_OPTIONS = {"help_option_names": ["-h", "--help"]}

app = typer.Typer(
    help=HELP,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings=HELP_OPTIONS,
)
recipes = typer.Typer(
    help="List recipes, and show their settings.",
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings=HELP_OPTIONS,
)
app.add_typer(recipes, name="recipe")
app.add_typer(batches, name="batch")
app.add_typer(caches, name="cache")


@app.callback(invoke_without_command=True)
def _main(
    version: Annotated[bool, typer.Option("--version", help="print the version")] = False,
) -> None:
    if version:
        print(__version__)
        raise typer.Exit


@app.command("run")
def run_command(
    photos: Annotated[
        list[Path],
        typer.Argument(help="a folder or ZIP of photos, photos, a video, or a workspace"),
    ],
    workspace: Annotated[
        Path | None,
        typer.Option(
            "--workspace", "-w", help="folder for the results [PHOTOS.refdgs]", metavar="DIR"
        ),
    ] = None,
    recipe_name: RecipeName = None,
    assignments: Assignments = None,
    until: Until = None,
    start: From = None,
    force: Force = None,
    longest: Annotated[
        float | None, typer.Option("--size", help="the object's longest side in metres")
    ] = None,
    network: Annotated[
        str | None,
        typer.Option("--mask-model", help="make masks with this ONNX network", metavar="FILE"),
    ] = None,
    cache: Cache = None,
    view: View = False,
    dry_run: DryRun = False,
    verify: Verify = False,
    device: Device = "auto",
    vram: Vram = "",
    cuda_graph: CudaGraph = None,
    threads: Threads = 0,
    as_json: Json = False,
    strict: Strict = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Make the asset from photos. Finished stages are reused."""
    limit, _ = bytes_of(vram), check_device(device)
    sized = [] if longest is None else [f"export.longest={longest}"]
    masked = [] if network is None else [mask_model.assignment(network)]
    given = [*(assignments or []), *sized, *masked]
    space = spaces.open_for_run(photos, workspace, recipe_name, given)
    again = {space.stage_name(name) for name in force or []}
    if start is not None:
        again |= space.pipeline.following(space.stage_name(start))
    until = space.stage_name(until) if until else None
    again = within(space, again, until)
    verbosity = 0 if quiet else 2 if verbose else 1
    how = (device, threads, as_json, strict, verbosity, limit, cuda_graph)
    options = Options(until, frozenset(again), *how, shared=shared_by(cache))
    if dry_run:
        print_plan(space, options)
        return
    if verify:
        make_sound(space, tell=spaces.note)
    with accompanied(space.root, wanted=view, threads=threads or core_count()):
        code = make(space, options)
    raise typer.Exit(code)


app.command("check")(check_command)
app.command("mat")(mat_command)


@app.command("rerun")
def rerun_command(
    workspace: Folder,
    stage: Stage,
    device: Device = "auto",
    vram: Vram = "",
    cuda_graph: CudaGraph = None,
    threads: Threads = 0,
    as_json: Json = False,
    strict: Strict = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Run one stage again. Later stages run only if its output changed."""
    space = spaces.open_workspace(workspace)
    again = frozenset({space.stage_name(stage)})
    verbosity = 0 if quiet else 2 if verbose else 1
    how = (device, threads, as_json, strict, verbosity, bytes_of(vram), cuda_graph)
    raise typer.Exit(make(space, Options(None, again, *how)))


app.command("status")(status_command)
app.command("view")(view_command)


@app.command("verify")
def verify_command(workspace: Folder, as_json: Json = False) -> None:
    """Compare every file with its record. Set aside what differs, and print all hashes."""
    from refdgs_pipe.cli import verify

    found = verify.examine(spaces.open_workspace(workspace))
    if as_json:
        _print_json(found.record())
    else:
        print(verify.describe(found))
    raise typer.Exit(found.exit_code)


@app.command("path")
def path_command(workspace: Folder, stage: Stage) -> None:
    """Print the folder of a stage's current result."""
    print(spaces.open_workspace(workspace).result(stage)[1])


@app.command("clean")
def clean_command(workspace: Folder, dry_run: DryRun = False, as_json: Json = False) -> None:
    """Delete old results. Those of the present settings and of the last run stay."""
    space = spaces.open_workspace(workspace)
    mark = space.fingerprint()
    paths = space.pipeline.unused(mark, space.settings)
    sizes = {str(path): spaces.weight(path) for path in paths}
    if not dry_run:
        space.pipeline.clean(mark, space.settings)
    if as_json:
        _print_json({"deleted": {} if dry_run else sizes, "unused": sizes})
        return
    word = "would free" if dry_run else "freed"
    for path in sizes:
        print(printable(path))
    print(f"{word} {size(sum(sizes.values()))}", file=sys.stderr)


@app.command("adopt")
def adopt_command(
    workspace: Folder,
    stage: Annotated[
        str,
        typer.Argument(
            help="a stage, or what it makes, such as mesh", autocompletion=completion.stages
        ),
    ],
    file: Annotated[Path | None, typer.Argument(help="your file, or folder of masks")] = None,
    drop: Annotated[bool, typer.Option("--drop", help="use the stage's own result again")] = False,
) -> None:
    """Use your own file as the result of a stage. It counts until the stage's input changes."""
    space = spaces.open_workspace(workspace)
    name = space.stage_name(stage)
    if drop == (file is not None):
        raise InputError("adopt: give a file, or --drop")
    if file is None:
        had = space.pipeline.drop_adopted(name)
        print(f"{name}: {'its own result again' if had else 'nothing was adopted'}")
        return
    space.pipeline.adopt(name, file, space.fingerprint(), space.settings)
    print(f"{name}: adopted from {printable(file.name)}. `run` makes what follows")


@app.command("render")
def render_command(
    workspace: Folder,
    out: Annotated[Path, typer.Option("--out", help="the folder to write to", metavar="DIR")],
    split: Annotated[
        str, typer.Option("--split", help="views to draw: train, test or all")
    ] = "test",
    orbit: Annotated[
        int, typer.Option("--orbit", min=0, help="draw this many views around the object instead")
    ] = 0,
    scale: Annotated[float, typer.Option("--scale", help="size; 1: as the photos")] = 1.0,
    device: Device = "auto",
    threads: Threads = 0,
) -> None:
    """Draw views of the trained model. NAME.png is on white; NAME.npz has normals and depth."""
    from refdgs_pipe.cli.render import render_views

    space = spaces.open_workspace(workspace)
    done = render_views(
        space, out, split=split, orbit=orbit, scale=scale, device=device, threads=threads
    )
    print(f"{done} views", file=sys.stderr)
    print(out)


@app.command("eval")
def eval_command(
    workspace: Folder,
    lpips_weights: Annotated[
        Path | None,
        typer.Option("--lpips-weights", help="weights for LPIPS, safetensors", metavar="FILE"),
    ] = None,
    device: Device = "auto",
    threads: Threads = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Score the result against held-out photos and ground truth. Missing stages are run."""
    from refdgs_pipe.cli.evaluation import describe, evaluate, open_for_scores

    space = open_for_scores(workspace, lpips_weights)
    verbosity = 0 if quiet else 1
    record = evaluate(space, Options(None, frozenset(), device, threads, as_json, False, verbosity))
    if as_json:
        _print_json(record)
    else:
        print(describe(record))


@app.command("report")
def report_command(
    workspace: Folder,
    out: Annotated[Path | None, typer.Option("--out", help="file to write", metavar="FILE")] = None,
    threads: Threads = 0,
) -> None:
    """Write the report again: WORKSPACE/report.html."""
    from refdgs_pipe.cli import report

    space = spaces.open_workspace(workspace)
    print(report.write(space, out, threads=threads))


@app.command("bench")
def bench_command(
    scenes: Annotated[list[Path], typer.Argument(help="captures, as `run` takes them")],
    out: Annotated[Path, typer.Option("--out", help="folder for all results", metavar="DIR")],
    recipes_wanted: Annotated[
        str,
        typer.Option(
            "--recipes",
            help="recipes, separated by commas",
            metavar="A,B",
            autocompletion=completion.recipe_lists,
        ),
    ] = recipe.DEFAULT,
    seeds: Annotated[
        str, typer.Option("--seeds", help="seeds, separated by commas", metavar="0,1")
    ] = "0",
    assignments: Assignments = None,
    device: Device = "auto",
    threads: Threads = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Score every scene with every recipe and seed. The same command resumes."""
    from refdgs_pipe.cli import bench, bench_table

    names, numbers = bench.listed(recipes_wanted, "--recipes"), bench.seeds_of(seeds)
    out = spaces.absolute(out)
    cells = bench.plan_grid(scenes, names, numbers, out, assignments or [])
    options = Options(device=device, threads=threads, verbosity=0 if quiet else 2 if verbose else 1)
    rows = bench.run_grid(cells, out, options)
    print(bench.summary(rows), file=sys.stderr)
    if as_json:
        _print_json(bench_table.record(rows))
    else:
        print(out / bench_table.TABLE)
    raise typer.Exit(next((row.exit_code for row in rows if row.status == "failed"), 0))


app.command("doctor")(doctor_command)


@recipes.command("list")
def recipe_list_command(as_json: Json = False) -> None:
    """List the recipes that come with the product."""
    found = [recipe.load(name) for name in recipe.names()]
    if as_json:
        listed = [
            {
                "name": r.name,
                "about": r.about,
                "draft": r.draft,
                "default": r.name == recipe.DEFAULT,
            }
            for r in found
        ]
        _print_json({"recipes": listed})
        return
    print("\n".join(aligned([(r.name, r.about) for r in found])))


@recipes.command("show")
def recipe_show_command(
    name: RecipeArgument = recipe.DEFAULT,
    assignments: Assignments = None,
    resolved: Annotated[
        bool, typer.Option("--resolved", help="every setting, not only the differences")
    ] = False,
    as_json: Json = False,
) -> None:
    """Print a recipe's settings with their meaning, as TOML."""
    from refdgs_pipe.pipeline.catalog import load_stages

    found = recipe.load(name)
    models = {stage.name: stage.params for stage in load_stages()}
    settings = recipe.resolve(found, assignments or [], models, tell=spaces.note)
    if as_json:
        _print_json({stage: params.model_dump(mode="json") for stage, params in settings.items()})
        return
    print(f"# {found.about}")
    if not resolved:
        changes = "What this recipe changes:" if found.tables else "The rest has its defaults."
        print(f"#\n# Most used:\n{recipe.basics(settings)}#\n# {changes}")
    print(recipe.describe(settings, only=None if resolved else found), end="")


def main() -> None:
    """Run the command line and end the process with its exit code."""
    end_with(app)


def _print_json(record: Any) -> None:
    print(write_json_text(record, indent=2))


if __name__ == "__main__":
    main()
