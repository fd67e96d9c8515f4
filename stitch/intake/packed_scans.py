"""Files that hold the scans of a whole campaign, E57 and Leica's PTX, as one file a scan."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from stitch.intake.folder_files import list_files
from stitch.reading.clouds import ptx_scans
from stitch.reading.text_files import import_extra

# Tables and descriptions that lie beside such a file are far smaller.
_SMALL_MB = 5.0


@contextmanager
def one_scan_a_file(folder: Path) -> Iterator[Path]:
    """Give the folder as it is, or, where a file holds several scans, a passing one with a file for each of them.

    Raises:
        InputError: the package that reads such files is not installed.
    """
    files = list_files(folder) if folder.is_dir() else []
    packed = {file: count for file in files if (count := _scan_count(file)) > 1}
    if not packed:
        yield folder
        return
    with TemporaryDirectory() as scratch:
        unpacked = Path(scratch) / folder.resolve().name
        unpacked.mkdir()
        for file in files:
            if file in packed:
                _unpack(file, packed[file], unpacked)
            elif file.stat().st_size < _SMALL_MB * 1e6:
                shutil.copyfile(file, unpacked / file.name)
        yield unpacked


def _scan_count(file: Path) -> int:
    if file.suffix.lower() == ".e57":
        return int(import_extra("pye57", file, "formats").E57(str(file)).scan_count)
    return len(ptx_scans(file)) if file.suffix.lower() == ".ptx" else 1


def _unpack(file: Path, count: int, folder: Path) -> None:
    """Write each scan, with its pose, to a file of its own, numbered in their order."""
    names = [folder / f"{file.stem}_{i:0{len(str(count - 1))}d}{file.suffix.lower()}" for i in range(count)]
    if file.suffix.lower() == ".ptx":
        for name, lines in zip(names, ptx_scans(file), strict=True):
            name.write_text("\n".join(lines) + "\n", encoding="ascii", errors="replace")
        return
    pye57 = import_extra("pye57", file, "formats")
    source = pye57.E57(str(file))
    for i, name in enumerate(names):
        header = source.get_header(i)
        fields = set(header.point_fields)
        columns = source.read_scan(
            i, ignore_missing_fields=True, transform=False, intensity="intensity" in fields, colors="colorRed" in fields
        )
        posed = header.has_pose()
        with pye57.E57(str(name), mode="w") as written:
            written.write_scan_raw(
                {field: np.asarray(column) for field, column in columns.items()},
                rotation=np.asarray(header.rotation) if posed else None,
                translation=np.asarray(header.translation) if posed else None,
            )
