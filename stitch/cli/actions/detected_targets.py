"""What `stitch detect` does: boards and balls in the scans of a session, as a table."""

import json
import sys
from pathlib import Path

import numpy as np

from stitch.cli.actions.looked_for import parse_target_options
from stitch.cli.options import require_new
from stitch.cli.terminal.streams import emit, results_stream
from stitch.errors import InputError
from stitch.intake.targets_in_scans import find_targets, points_columns, scans_of_session, views_of_targets
from stitch.measurement.labelled_points import Sighting
from stitch.reading.session_folder import load_session
from stitch.system.whole_file import whole_file
from stitch.writing.session_files import table_text, write_table


def run_detect(
    session: Path, board: list[str] | None, ball: list[str] | None, output: Path | None, as_json: bool
) -> None:
    """Find targets and write them.

    Raises:
        InputError, NoResultError: as `stitch detect` ends.
    """
    wanted = parse_target_options(board, ball)
    if wanted.is_empty:
        raise InputError("stitch detect: nothing to look for; to fix: state --board or --ball")
    require_new(output)
    loaded = load_session(session, at_most=None)
    found, notes = find_targets(scans_of_session(loaded), wanted)
    views = loaded.names
    columns = points_columns(views, found)
    if output is not None:
        with whole_file(output) as scratch:
            write_table(scratch, columns)
    for note in notes:
        print(f"{note}.", file=sys.stderr)
    if as_json:
        emit(json.dumps(_document(session, views, found, notes), indent=1))
    elif output is None:
        results_stream().write(table_text(columns))
    showing = sum(bool(s.targets) for s in found)
    count = len(views_of_targets(found))
    where = output or "standard output"
    print(f"{where}: {count} target{'s' * (count > 1)} in {showing} of {len(views)} views", file=sys.stderr)
    if output == session / "points.csv":
        print(f"Next: stitch run {session}", file=sys.stderr)


def _document(session: Path, views: list[str], sightings: list[Sighting], notes: list[str]) -> dict[str, object]:
    return {
        "session": str(session),
        "views": {view: len(s.targets) for view, s in zip(views, sightings, strict=True)},
        "targets": views_of_targets(sightings),
        "median_sigma": float(np.median(np.concatenate([s.sigma for s in sightings]))),
        "notes": notes,
    }
