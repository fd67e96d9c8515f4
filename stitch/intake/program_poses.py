"""Poses of a robot program: its points that have one."""

import csv
from pathlib import Path

from stitch.controllers.imported_rows import POSE_COLUMNS, csv_text
from stitch.controllers.importer import import_file
from stitch.intake.number_table import parse_number_table
from stitch.intake.raw_poses import RawPoses

PROGRAMS = (".ls", ".src", ".mod", ".script")
_KUKA_DATA = ".dat"
_LOOKED_AT = 65536


def is_program(file: Path) -> bool:
    """Whether a file is a program of a robot; .dat is the ending of a KUKA's points, and of many a table."""
    kind = file.suffix.lower()
    if kind != _KUKA_DATA:
        return kind in PROGRAMS
    with file.open("rb") as stream:
        return b"DEFDAT" in stream.read(_LOOKED_AT).upper()


def read_by_its_program(file: Path) -> bool:
    """Whether a file holds the points of a KUKA's program that lies beside it, which is read instead."""
    return file.suffix.lower() == _KUKA_DATA and any(file.with_suffix(s).exists() for s in (".src", ".SRC"))


def program_poses(file: Path) -> RawPoses:
    """Points with a pose, mm; of a program with joint targets alone, these.

    Raises:
        InputError, NoResultError: as the program's reader does.
    """
    told = import_file(file, "mm")
    header, *body = list(csv.reader(told.text.splitlines()))
    posed = POSE_COLUMNS[-1] in header
    kept = [row for row in body if row[-1]] if posed else body
    columns = [i for i in range(len(header)) if all(row[i] for row in kept)]
    table = parse_number_table(file, csv_text([[row[i] for i in columns] for row in [header, *kept]]))
    words = "the points of a robot program"
    left = len(body) - len(kept)
    words += f", {left} without a pose left out" if left else ""
    if told.warnings:
        words += (
            "; where a tool or a base was in force, the hand-eye is that of the tool, unless `stitch import --frame … "
            "--tool …` has made flange poses of them"
        )
    return RawPoses(str(file), table.header, table.numbers, table.labels, words)
