"""A column with a gap is not used, and that is said."""

from dataclasses import replace

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.session.measurement import views_of
from stitch.session.notes import gaps_note


def test_a_column_with_a_gap_is_told_and_not_used():
    session = labelled_cell(3, views=5)[0]
    assert gaps_note(session) == ""
    full = replace(session, views=[replace(v, covariates={"hall": 20.0}) for v in session.views])
    assert gaps_note(full) == "" and views_of(full).has("hall")
    gap = replace(full, views=[*full.views[:3], *(replace(v, covariates={}) for v in full.views[3:])])
    first = gap.names[3]
    assert gaps_note(gap) == f"Not used, since some views have none: hall ({first} and 1 more without)."
    assert not views_of(gap).has("hall")


def test_so_is_a_time_or_a_pose_of_joints_that_is_missing_once():
    session = labelled_cell(3, views=5)[0]
    views = [*session.views[:4], replace(session.views[4], time_s=None, joints=None)]
    told = gaps_note(replace(session, views=views))
    assert ("time_s" in told) == any(v.time_s is not None for v in views) and "joint angles (" in told
