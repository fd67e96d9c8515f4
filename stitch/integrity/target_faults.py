"""What is wrong with labelled points whatever the poses are: names that are mixed up, targets that moved."""

from stitch.integrity.linkage import only
from stitch.integrity.moved_targets import moved_targets
from stitch.integrity.problems import Problem
from stitch.measurement.session import Session
from stitch.measurement.sightings import Sightings
from stitch.observations.targets.mislabelled import mislabelled, named_right
from stitch.units import length_text


def target_faults(session: Session, sightings: Sightings | None) -> list[Problem]:
    """Views with names mixed up, then targets that moved, with the views from there on; nothing without targets."""
    if sightings is None:
        return []
    names, every = session.names, sightings.everything
    mixed_up = mislabelled(every)
    out = [Problem("exchanged", (names[m.view],), m.said(names[m.view])) for m in mixed_up]
    for moved in moved_targets(named_right(every) or every):
        views = () if moved.creeps else only(range(moved.start, len(names)), names)
        length = length_text(moved.distance, session.length_unit)
        out.append(Problem("displaced", tuple(views), moved.said(names[moved.start], length)))
    return out


def said_of_targets(session: Session, sightings: Sightings | None) -> tuple[str, ...]:
    """The same in words, each a sentence or two."""
    return tuple(problem.fix for problem in target_faults(session, sightings))
