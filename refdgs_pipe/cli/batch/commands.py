"""The commands of `batch`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from refdgs_pipe import recipe
from refdgs_pipe.cli import workspace as spaces
from refdgs_pipe.cli.options import Assignments, Cache, Device, DryRun, Json, RecipeName, Threads
from refdgs_pipe.documents import write_json_text
from refdgs_pipe.formatting import counted

batches = typer.Typer(
    help="Run many captures on this machine, Slurm or Kubernetes.",
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
Folder = Annotated[Path, typer.Argument(help="the folder that `batch init` made", metavar="BATCH")]


@batches.command("init")
def init_command(
    captures: Annotated[
        list[Path], typer.Argument(help="for each capture, a folder or ZIP of photos, or a video")
    ],
    out: Annotated[Path, typer.Option("--out", help="the folder of the batch", metavar="DIR")],
    recipe_name: RecipeName = None,
    assignments: Assignments = None,
    cache: Cache = None,
) -> None:
    """Write captures.tsv, a Snakefile and profiles to edit. Called again, it adds captures."""
    from refdgs_pipe.cli.batch.init import init

    chosen = recipe_name or recipe.DEFAULT
    sets = assignments or []
    batch, added = init(captures, out, recipe_name=chosen, assignments=sets, cache=cache)
    words = f"{counted(added, 'capture')} added, {len(batch.captures)} in all"
    print(f"{words}. Next: refdgs-pipe batch run {out}", file=sys.stderr)
    print(batch.root)


@batches.command("run")
def run_command(
    batch: Folder,
    profile: Annotated[
        str, typer.Option("--profile", help="local, slurm, kubernetes or your own")
    ] = "local",
    cores: Annotated[
        int, typer.Option("--cores", min=0, help="CPU cores; 0: every core of this machine")
    ] = 0,
    gpus: Annotated[
        int | None,
        typer.Option("--gpus", min=0, help="most jobs on GPUs at once [local: all GPUs; else 0]"),
    ] = None,
    shard: Annotated[
        int, typer.Option("--shard", min=1, help="captures that Snakemake plans at once")
    ] = 1000,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="also try captures again that failed for good")
    ] = False,
    dry_run: DryRun = False,
) -> None:
    """Run every capture that is not finished. The same command resumes."""
    from refdgs_pipe.cli.batch.run import Plan, exit_code, run, summary
    from refdgs_pipe.cli.batch.table import Batch

    found = Batch.read(spaces.absolute(batch))
    stood = run(found, Plan(profile, cores, gpus, shard, retry_failed, dry_run))
    print("\n".join(summary(found, stood)), file=sys.stderr)
    raise typer.Exit(0 if dry_run else exit_code(stood))


@batches.command("step", hidden=True)
def step_command(
    batch: Folder,
    capture: Annotated[str, typer.Argument(help="its name in captures.tsv")],
    part: Annotated[str, typer.Argument(help="prepare, train or finish")],
    device: Device = "cpu",
    threads: Threads = 0,
    wait: Annotated[
        float, typer.Option("--wait", min=0, help="seconds to wait for a run that is going on")
    ] = 600.0,
) -> None:
    """Do one job of one capture. Snakemake calls this."""
    from refdgs_pipe.cli.batch.step import How, step
    from refdgs_pipe.cli.batch.table import Batch

    step(Batch.read(spaces.absolute(batch)), capture, part, How(device, threads, wait))


@batches.command("status")
def status_command(
    batch: Folder,
    every: Annotated[
        bool, typer.Option("--all", help="also list captures that are done or waiting")
    ] = False,
    as_json: Json = False,
) -> None:
    """Say how many captures are done, running, waiting or failed. Name those to look at."""
    from refdgs_pipe.cli.batch import standing
    from refdgs_pipe.cli.batch.table import Batch

    found = Batch.read(spaces.absolute(batch))
    stood = standing.standings(found)
    if as_json:
        print(write_json_text(standing.record(found, stood), indent=2))
    else:
        print("\n".join(standing.describe(stood, every=every)))


@batches.command("report")
def report_command(
    batch: Folder,
    out: Annotated[
        Path | None, typer.Option("--out", help="file to write [BATCH/report.html]", metavar="FILE")
    ] = None,
) -> None:
    """Write one page with a table and pictures of all assets. They link to the reports."""
    from refdgs_pipe.cli.batch.page import write
    from refdgs_pipe.cli.batch.table import Batch

    print(write(Batch.read(spaces.absolute(batch)), out))
