"""Names of labelled points beside errors that have none: laws and memory of another program, and what is really there."""

import numpy as np
import pytest

from data_synth.arms import ARMS
from data_synth.fixtures.labelled_arm import TARGETS, flange, joints_of, labelled_cell
from data_synth.laws.unnamed import UNNAMED
from data_synth.moment import Plan
from data_synth.ordinary_arm import with_memory
from stitch.api.pipeline import diagnose, run
from stitch.diagnosis.unmodelled_time_effects import least_log_bayes_factor, unmodelled_trends

VIEWS, SEED = 120, 31


def law(name: str) -> np.ndarray:
    """(V, 6) rad, three times as large as a good arm's."""
    joints = joints_of(np.random.default_rng(SEED), VIEWS)
    plan = Plan(joints, 0 * joints, 0 * joints, next(iter(ARMS.values())), useful=tuple(range(6)))
    return 3 * UNNAMED[name](plan, np.random.default_rng([SEED, 1]))


def memory() -> np.ndarray:
    """(V, 6) rad and mm of a flange: AR(1), 0.9, of 120 µm and 0.12 mrad."""
    return with_memory(VIEWS, 0.9, np.random.default_rng([SEED, 2])) * np.repeat([1.2e-4, 0.12], 3)


@pytest.mark.parametrize(
    "which", [*(pytest.param(law, marks=pytest.mark.slow) for law in ("hysteresis", "dress_pack")), "memory"]
)
def test_what_no_library_has_gets_no_name(which):
    nothing = np.zeros((VIEWS, 6))
    errors = (nothing, memory()) if which == "memory" else (law(which), nothing)
    session, *_ = labelled_cell(SEED, views=VIEWS, errors=errors, targets=TARGETS[:2])
    found = diagnose(run(session))
    assert found.verdict == "unknown_effect", found.sentence
    if which == "memory":
        assert [u.words for u in found.repeating_errors] == ["wander in time"]
    else:
        joint = 1 + int(np.abs(errors[0]).sum(axis=0).argmax())
        assert [u.words for u in found.repeating_errors] == [f"follow the joints, joint {joint} above all"]


@pytest.mark.slow
def test_joints_that_scatter_do_not_repeat():
    """Every joint anew at every pose, 40 µrad beside a steady flange: scatter, and as large as it was drawn."""
    for seed in range(4):
        off = 4e-5 * np.random.default_rng([SEED, seed]).standard_normal((40, 6))
        session, *_ = labelled_cell(SEED + seed, views=40, scatter=(1e-5, 0.01), errors=(off, np.zeros((40, 6))))
        found = diagnose(run(session))
        assert found.verdict == "adequate", found.sentence
        joints = joints_of(np.random.default_rng(SEED + seed), 40)
        moved = np.array([flange(q + e)[:3, 3] - flange(q)[:3, 3] for q, e in zip(joints, off, strict=True)])
        drawn = np.sqrt((moved**2).mean() + 0.01**2)
        assert found.translation == pytest.approx(drawn, rel=0.35)


@pytest.mark.usefixtures("few_effects")
def test_beside_a_law_scatter_is_what_the_arm_scatters():
    """20 µm are drawn, and the law does not take them for itself; of what it turns most is no scatter any more."""
    session, *_ = labelled_cell(SEED, views=VIEWS, errors=(law("coupling"), np.zeros((VIEWS, 6))))
    found = diagnose(run(session))
    assert found.repeating_errors and found.translation == pytest.approx(0.02, rel=0.25), found.sentence
    assert found.rotation**2 < 0.5 * found.linear.null.variances[0]


def test_an_effect_that_is_there_is_wanted_beside_them_one_that_is_not_is_idle():
    """Beside a joint without a name that errs too: what is left of the evidence for the offset still names it."""
    errors = (law("dress_pack"), np.zeros((VIEWS, 6)))
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(SEED, views=VIEWS, offset=offset, errors=errors, targets=TARGETS[:2])
    found = diagnose(run(session))
    assert found.effects == ("joint_offset",), found.sentence
    scored = found.candidates[0].ranked.score
    assert found.candidates[0].name == "joint_offset" and least_log_bayes_factor(found.linear, scored) > 20
    beside = found.linear.conditioned_on(scored.form.columns, scored.sizes)
    idle = next(c.ranked.score for c in found.candidates if c.name == "gear_harmonic")
    assert least_log_bayes_factor(beside, idle) < 3
    # The law that is there is seen: a process explains it, with less scatter than the views seemed to have.
    likeliest = unmodelled_trends(beside)[0]
    assert 0.5 * (beside.null.deviance - likeliest.fit.deviance) > 20
    assert likeliest.fit.variances[0] < beside.null.variances[0]
