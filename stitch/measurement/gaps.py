"""Columns of views.csv that do not count, since in some views nothing stands there."""

from stitch.measurement.session import Session


def gaps_note(session: Session) -> str:
    """In one sentence, with a view that lacks each; empty where there is no gap."""
    lacking = dict[str, list[str]]()
    columns = sorted({name for view in session.views for name in view.covariates})
    for name, view in zip(session.names, session.views, strict=True):
        gaps = [column for column in columns if column not in view.covariates]
        gaps += ["time_s"] if view.time_s is None else []
        gaps += ["joint angles"] if view.joints is None else []
        for column in gaps:
            lacking.setdefault(column, []).append(name)
    # What no view has is no gap.
    found = [
        f"{column} ({views[0]}{f' and {len(views) - 1} more' if len(views) > 1 else ''} without)"
        for column, views in lacking.items()
        if len(views) < len(session.views)
    ]
    return f"Not used, since some views have none: {', '.join(found)}." if found else ""
