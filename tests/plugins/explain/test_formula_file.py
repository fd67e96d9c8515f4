"""What is told of a formula and its file: lengths in mm in any session, and what its code reads of the views."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.effects.contract import EFFECTS, missing_need
from stitch.effects.user_file import load
from stitch.plugins.explain.dictionary import Ingredient, coefficient
from stitch.plugins.explain.formula_file import effect_source, formula_text
from stitch.plugins.explain.quantities import view_quantities
from stitch.session.measurement import views_of
from stitch.session.torques import no_torques
from tests.plugins.explain.test_explain import evidence

SHIFT = 8e-5  # m, where the payload is largest


def measured_views(count=12):
    """With all that a session may know of its views."""
    session, *_ = labelled_cell(3, views=count, payload=np.linspace(1, 4, count))
    views = views_of(session)
    turning = np.gradient(views.joints, axis=0)
    return replace(views, time=np.arange(count) * 60.0, velocity=turning)


def loaded(source, tmp_path):
    (tmp_path / "mine.py").write_text(source, encoding="utf-8")
    load(tmp_path / "mine.py")
    return EFFECTS["explained"]


@pytest.mark.parametrize(("unit", "size"), [("m", SHIFT), ("mm", 1e3 * SHIFT)])
def test_a_displacement_is_told_in_mm_whatever_the_session_is_in(unit, size, tmp_path):
    payload = next(q for q in view_quantities(measured_views()) if q.text == "payload_kg")
    own = [Ingredient("part", axis, payload) for axis in (0, 3)]
    values = [coefficient(i, x, unit) for i, x in zip(own, (3e-4, size), strict=True)]
    text = formula_text(own, values)
    # The payload grows by 3 kg.
    assert text == "part rx, tx = (+0.0001) rad/(payload_kg), (+0.027) mm/(payload_kg) · payload_kg"
    parameters = loaded(effect_source("explained", own, values, text), tmp_path).parameters(6, (), unit)
    assert parameters[1].typical == pytest.approx(size / 3, rel=0.02)


def test_quantities_read_no_more_of_the_views_than_they_say():
    whole, seen = measured_views(), set()
    for quantity in view_quantities(whole):
        own, has = quantity.needs, set(quantity.needs)
        bare = replace(
            whole,
            **{} if "joints" in has else dict.fromkeys(("joints", "previous", "approach", "path")),
            time=whole.time if "time" in has else None,
            velocity=whole.velocity if "velocity" in has else None,
            torques=whole.torques if "torque" in has else no_torques(whole.count),
            covariates={name: course for name, course in whole.covariates.items() if name in has},
        )
        values = eval(quantity.code, {"np": np, "views": bare})
        np.testing.assert_allclose(values, quantity.values, rtol=1e-5, atol=1e-7, err_msg=f"{quantity.text} {own}")
        seen |= has
    assert seen == {"joints", "time", "velocity", "torque", "payload_kg"}


@pytest.mark.parametrize(("place", "written"), [("part", '("payload_kg",)'), ("robot", '("joints", "payload_kg")')])
def test_a_file_that_reads_a_column_is_not_asked_where_there_is_none(place, written, tmp_path):
    found = {q.text: q for q in view_quantities(measured_views())}
    followed = found["payload_kg"] if place == "part" else found["sin q2"].times(found["payload_kg"])
    source = effect_source("explained", [Ingredient(place, 1, followed)], [1e-4], "Found.")
    assert f"needs={written}," in source
    effect = loaded(source, tmp_path)
    assert missing_need(evidence(1, views=8).measurement, effect) == ("payload_kg",)
    assert not missing_need(evidence(1, views=8, payload=np.linspace(1, 4, 8)).measurement, effect)
