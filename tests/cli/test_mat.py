"""`mat` writes a PDF, `--size` is a setting, and an unknown size is said."""

from pathlib import Path

import pytest

from refdgs_pipe.cli.mat import mat_command
from refdgs_pipe.errors import InputError
from refdgs_pipe.export.product import told_size


def test_the_mat_is_written_for_both_papers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for paper, size in (("A4", b"841.8898"), ("letter", b"792.0000")):
        out = tmp_path / "new" / f"{paper}.pdf"
        mat_command(out, paper)
        data = out.read_bytes()
        assert data.startswith(b"%PDF-1.6") and data.endswith(b"%%EOF\n") and size in data
        assert capsys.readouterr().out == f"{out}\n"


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--paper a3"):
        mat_command(tmp_path / "mat.pdf", "a3")
    with pytest.raises(InputError, match="PDF file"):
        mat_command(tmp_path, "a4")
    with pytest.raises(InputError, match="PDF file"):
        mat_command(tmp_path / "mat.png", "a4")


def test_the_size_is_told_in_words() -> None:
    class Mesh:
        import numpy as np

        vertices = np.array([[0, 0, 0], [1, 2, 0.5]])

    assert told_size(Mesh, 0.1, "given") == "0.2 m, given"  # type: ignore[arg-type]
    unknown = told_size(Mesh, 1.0, "unknown")  # type: ignore[arg-type]
    assert unknown.startswith("unknown: exported 2 m long") and "--size" in unknown
