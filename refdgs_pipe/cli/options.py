"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from refdgs_pipe.cli import completion

Folder = Annotated[Path, typer.Argument(help="the folder that `run` made", metavar="WORKSPACE")]
RecipeName = Annotated[
    str | None,
    typer.Option(
        "--recipe",
        help="a recipe's name, or a TOML file",
        metavar="NAME",
        autocompletion=completion.recipes,
    ),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="change one setting; may be repeated; see recipe show",
        metavar="STAGE.KEY=VALUE",
        autocompletion=completion.settings,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="print one JSON object on stdout")]
Device = Annotated[
    str,
    typer.Option("--device", help="auto, cpu, cuda or cuda:N", autocompletion=completion.devices),
]
Threads = Annotated[int, typer.Option("--threads", min=0, help="CPU threads; 0: every core")]
Vram = Annotated[str, typer.Option("--vram", help="most GPU memory to use", metavar="8GB")]
CudaGraph = Annotated[
    bool | None,
    typer.Option(
        "--cuda-graph/--no-cuda-graph", help="replay GPU steps as CUDA graphs [where equal]"
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="only warnings and errors")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="also every measured figure")]
Strict = Annotated[bool, typer.Option("--strict", help="exit with 3 on warnings or a poor verdict")]
Verify = Annotated[bool, typer.Option("--verify", help="first compare every file with its record")]
Cache = Annotated[
    str | None,
    typer.Option(
        "--cache", help="share results in s3://, gs://, az:// or a folder", metavar="PLACE"
    ),
]
View = Annotated[bool, typer.Option("--view", help="show the run in a browser")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="only say what would be done")]


Stage = Annotated[
    str, typer.Argument(help="a stage", metavar="STAGE", autocompletion=completion.stages)
]
Until = Annotated[
    str | None,
    typer.Option(
        "--until",
        help="stop after this stage",
        metavar="STAGE",
        autocompletion=completion.stages,
    ),
]
From = Annotated[
    str | None,
    typer.Option(
        "--from",
        help="run this stage and all later ones again",
        metavar="STAGE",
        autocompletion=completion.stages,
    ),
]
Force = Annotated[
    list[str] | None,
    typer.Option(
        "--force",
        help="run this stage again; may be repeated",
        metavar="STAGE",
        autocompletion=completion.stages,
    ),
]
RecipeArgument = Annotated[
    str,
    typer.Argument(help="a recipe's name, or a TOML file", autocompletion=completion.recipes),
]
