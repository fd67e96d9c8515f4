"""What is said of a session before anything is fitted: of its payload, its sensor, and what does not count."""

from collections import defaultdict

from stitch.session.measurement import all_ahead, sensor_kind
from stitch.session.session import SessionData
from stitch.session.torques import PAYLOAD


def session_notes(session: SessionData) -> list[str]:
    """Return sentences on what is assumed of a session before anything is fitted; `check` and `run` print them."""
    return [note for note in (payload_note(session), gaps_note(session), sensor_note(session)) if note]


def payload_note(session: SessionData) -> str:
    """Return a sentence that a payload of unknown centre of mass counts at the flange's origin; "" if none does.

    None does where the centre is stated, nothing is carried, or gravity's torques are not needed: joints are missing,
    or drives report the torques.
    """
    robot = session.robot
    if robot is None or not robot.carries_at_flange or any(view.joints is None for view in session.views):
        return ""
    columns = [view.covariates for view in session.views]
    if all("j1_torque_nm" in column for column in columns):
        return ""  # drives report what bends the joints
    loads = [column.get(PAYLOAD, robot.payload_mass) for column in columns]
    if not any(loads):
        return ""
    return (
        f"The payload, up to {max(loads):g} kg, counts at the flange's origin: [robot] payload states no other centre "
        "of mass (com)."
    )


def gaps_note(session: SessionData) -> str:
    """Return a sentence that lists columns of views.csv that are not used, since some views lack them; "" if none.

    For each column the first view that lacks it is named.
    """
    without = defaultdict[str, list[str]](list)
    columns = sorted({name for view in session.views for name in view.covariates})
    for view in session.views:
        gaps = [column for column in columns if column not in view.covariates]
        gaps += ["time_s"] if view.time_s is None else []
        gaps += ["joint angles"] if view.joints is None else []
        for column in gaps:
            without[column].append(view.name)
    # A column that all views lack was not measured: no gap.
    notes = [
        f"{column} ({views[0]}{f' and {len(views) - 1} more' if len(views) > 1 else ''} without)"
        for column, views in without.items()
        if len(views) < len(session.views)
    ]
    return f"Not used, since some views have none: {', '.join(notes)}." if notes else ""


def sensor_note(session: SessionData) -> str:
    """Return a sentence on the kind that the sensor of labelled points is taken for; "" where it is stated.

    Also "" for scans, and without labelled points.
    """
    points = [view.sighting.points for view in session.views if view.sighting is not None]
    if session.scanner.kind is not None or session.has_clouds or not points:
        return ""
    if sensor_kind(session) == "tracker":
        return "The sensor is taken for a tracker, since its points are given in the robot's base."
    if not all_ahead(points):
        return "The sensor is taken for one without a lens, since it shows points beside or behind itself."
    return (
        "The sensor's kind is not stated, so errors of a scanner are tried too; "
        'to leave them out, write kind = "tracker" under [scanner] in session.toml.'
    )
