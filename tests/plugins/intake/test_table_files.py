"""Arrays and workbooks that unpack to more than any table of poses are refused before they are read."""

import struct
import time
import zipfile
import zlib
from contextlib import nullcontext

import numpy as np
import pytest
from scipy.io import savemat

from stitch.errors import InputError
from stitch.plugins.intake.table_files import require_array_room, require_workbook_room


@pytest.mark.parametrize("kind", ["mat", "npz", "mat of zeros"])
def test_arrays_that_are_packed_a_thousand_times_are_refused_before_they_are_unpacked(tmp_path, kind):
    file = tmp_path / f"poses.{kind[:3]}"
    small = np.tile(np.eye(4), (100, 1, 1))
    if kind == "mat":
        inside = struct.pack("<II", 14, 2_000_000_000) + bytes(1000)
        packed = zlib.compress(inside)
        savemat(file, {"T": small})
        file.write_bytes(file.read_bytes() + struct.pack("<II", 15, len(packed)) + packed)
    elif kind == "npz":
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for k in range(3):
                archive.writestr(f"{k}.npy", bytes(80_000_000))
    else:
        savemat(file, {"T": np.zeros((4, 4, 2_000_000))}, do_compression=True)
    began = time.process_time()
    with pytest.raises(InputError, match="bytes of arrays announced"):
        require_array_room(file)
    assert time.process_time() - began < 1.0
    savemat(tmp_path / "small.mat", {"T": small}, do_compression=True)
    np.savez_compressed(tmp_path / "small.npz", T=small)
    require_array_room(tmp_path / "small.mat")
    require_array_room(tmp_path / "small.npz")


@pytest.mark.parametrize(
    ("cells", "padding", "message"),
    [
        ('<c r="A1"><v>1</v></c><c t="n" r="XFD1048576"><v>1</v></c>', 0, "17179869184 cells"),
        ("<x:c r='ZZ1048576'><v>1</v></x:c><c r='A1'><v>1</v></c>", 0, "736100352 cells"),
        ('<c r="A1"><v>1</v></c>', 201_000_000, "bytes of sheets announced"),
        ('<c r="T1000000"><v>1</v></c><c r="XFD1048576" s="1"/>', 0, None),
    ],
)
def test_a_workbook_that_fills_the_memory_is_refused_before_it_is_read(tmp_path, cells, padding, message):
    file = tmp_path / "poses.xlsx"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", f"<sheetData><row>{cells}</row></sheetData>" + " " * padding)
    with pytest.raises(InputError, match=message) if message else nullcontext():
        require_workbook_room(file)
