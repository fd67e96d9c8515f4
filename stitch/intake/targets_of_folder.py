"""Boards and balls in the scans of a raw folder, before anybody says how its poses are to be read."""

from collections.abc import Sequence

from stitch.frames import Array
from stitch.intake.found_files import FolderFiles
from stitch.intake.guesses import Guess
from stitch.intake.targets_in_scans import TargetSearch, ViewScans, find_targets, views_of_targets
from stitch.intake.ways import MM
from stitch.measurement.labelled_points import Sighting


def find_folder_targets(
    files: FolderFiles, clouds: Sequence[Array], metres: float, search: TargetSearch
) -> tuple[tuple[Sighting, ...], tuple[Guess, ...]]:
    """What every cloud shows of the targets that are looked for, mm; nothing where none are.

    Args:
        clouds: (N, 3) of the files, in their own unit.
        metres: of that unit.
    """
    if search.is_empty:
        return (), ()
    own = tuple(cloud * metres / MM for cloud in clouds)
    scans = ViewScans(files.folder, files.clouds, metres, MM, own, (None,) * len(own))
    sightings, notes = find_targets(scans, search)
    count = sum(bool(s.targets) for s in sightings)
    words = f"{len(views_of_targets(sightings))} in {count} of {len(sightings)} clouds"
    reason = "; ".join(("found where they were looked for", *notes))
    return tuple(sightings), (Guess("targets", words, reason, True, "--board, --ball"),)
