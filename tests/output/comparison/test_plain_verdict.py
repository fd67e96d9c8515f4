"""What a run's history says for everybody, of histories made by hand."""

from types import SimpleNamespace

from stitch.output.comparison.run_verdict import plain_verdict


def history(*names):
    """Steps between coarse and register whose views disagree by 100, 90, 80 … µm, 5 µm after register."""
    models = [
        SimpleNamespace(name=name, field=SimpleNamespace(mean_abs=0.1 - 0.01 * i)) for i, name in enumerate(names)
    ]
    register = SimpleNamespace(name="register", field=SimpleNamespace(mean_abs=0.005))
    return SimpleNamespace(models=models, steps=(*models, register))


def test_an_effect_that_was_dropped_again_has_brought_nothing():
    told = plain_verdict(history("hand-eye alone", "+ backlash", "− backlash"), "mm")
    assert "backlash" not in told and "the views disagree by 80 µm" in told and "5 µm remain" in told


def test_what_was_added_and_stayed_is_named_with_all_that_it_brought():
    told = plain_verdict(history("hand-eye alone", "+ backlash", "+ settling, − backlash", "+ latency"), "mm")
    assert told.startswith("Adding settling and latency brought the views from 100 µm to 70 µm of each other")
