"""What is wrong with labelled points whatever the poses are: names that are mixed up, targets that moved."""

from stitch.integrity.linkage import names_of_views
from stitch.integrity.moved_targets import find_moved_targets
from stitch.integrity.problems import SessionProblem
from stitch.measurement.session import Session
from stitch.measurement.sightings import Sightings
from stitch.observations.targets.mislabelled import drop_mislabelled, find_mislabelled
from stitch.units import length_text


def target_problems(session: Session, sightings: Sightings | None) -> list[SessionProblem]:
    """Views with names mixed up, then targets that moved, with the views from there on; nothing without targets."""
    if sightings is None:
        return []
    names, every = session.names, sightings.with_outliers
    mixed_up = find_mislabelled(every)
    out = [SessionProblem("exchanged", (names[m.view],), m.message(names[m.view])) for m in mixed_up]
    for moved in find_moved_targets(drop_mislabelled(every) or every):
        views = () if moved.drifts else names_of_views(range(moved.start, len(names)), names)
        length = length_text(moved.distance, session.length_unit)
        out.append(SessionProblem("displaced", tuple(views), moved.describe(names[moved.start], length)))
    return out


def target_warnings(session: Session, sightings: Sightings | None) -> tuple[str, ...]:
    """The same in words, each a sentence or two."""
    return tuple(problem.fix for problem in target_problems(session, sightings))
