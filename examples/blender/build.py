"""Write the Blender add-on as a ZIP: python examples/blender/build.py FOLDER

Equal sources give equal bytes: names are sorted, and every file has the same date.
"""

import sys
import tomllib
import zipfile
from pathlib import Path

HERE = Path(__file__).parent
SOURCE = HERE / "refdgs_pipe_blender"
LICENCE = HERE.parent.parent / "LICENSE"
DATE = (1980, 1, 1, 0, 0, 0)  # the first that a ZIP can hold
ENDINGS = {".py", ".toml"}


def build(folder: Path) -> Path:
    """Write `refdgs_pipe_blender-VERSION.zip` into a folder, and return its path.

    Raises:
        OSError: a file cannot be read or written.
        zipfile.BadZipFile: what was written cannot be read again.
    """
    manifest = tomllib.loads((SOURCE / "blender_manifest.toml").read_text("utf-8"))
    files = {path.name: path for path in SOURCE.iterdir() if path.suffix in ENDINGS}
    files["LICENSE"] = LICENCE
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{manifest['id']}-{manifest['version']}.zip"
    with zipfile.ZipFile(target, "w") as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system, entry.external_attr = 3, 0o644 << 16  # as on Linux
            archive.writestr(entry, files[name].read_bytes())
    with zipfile.ZipFile(target) as archive:
        if (damaged := archive.testzip()) or sorted(archive.namelist()) != sorted(files):
            raise zipfile.BadZipFile(f"{target}: {damaged or 'files'} differ. Build it again")
    return target


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/blender/build.py FOLDER")
    print(build(Path(sys.argv[1])))
