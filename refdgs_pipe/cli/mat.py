"""The command that prints the mat."""

from pathlib import Path
from typing import Annotated

import typer

from refdgs_pipe.errors import InputError


def mat_command(
    out: Annotated[Path, typer.Option("--out", help="the PDF to write", metavar="FILE")],
    paper: Annotated[str, typer.Option("--paper", help="a4 or letter")] = "a4",
) -> None:
    """Write a mat to print. Below the object, it gives size, up direction and camera positions."""
    from refdgs_pipe.mat.drawing import pdf
    from refdgs_pipe.mat.layout import mat_of
    from refdgs_pipe.pipeline.atomic import disk_errors

    name = paper.strip().lower()
    if name not in ("a4", "letter"):
        raise InputError(f"--paper {paper}: expected a4 or letter")
    if out.suffix.lower() != ".pdf" or out.is_dir():
        raise InputError(f"--out {out}: expected the name of a PDF file, such as mat.pdf")
    with disk_errors(out.parent):
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(pdf(mat_of("a4" if name == "a4" else "letter")))
    print(out)
