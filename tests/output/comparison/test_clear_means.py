"""The clearest of many means: how often chance makes one, and what is said once."""

import numpy as np
import pytest

from stitch.output.comparison.residual_tables import comparison_document, equal_count_bins, property_varies
from tests.output.comparison.compared_views import compared


def clean(seed, views):
    rng = np.random.default_rng(seed)
    properties = {f"j{i}": rng.normal(size=views) for i in range(20)}
    properties |= {f"approach of j{i}": rng.choice([-1.0, 1.0], size=views) for i in range(6)}
    errors = rng.normal(scale=0.012, size=views)
    return errors - errors.mean(), properties


@pytest.mark.slow
@pytest.mark.parametrize("views", [7, 12, 18])
def test_chance_makes_something_clear_in_one_of_twenty_cells_at_most(views):
    cells = [compared(*clean(seed, views)) for seed in range(100)]
    # Ten of a hundred is what a rate of five in a hundred exceeds once in a hundred.
    assert sum(cell.is_clear(cell.places[0]) for cell in cells) <= 10


def test_what_is_off_with_the_approach_is_clear_and_stands_first():
    for seed in range(10):
        errors, properties = clean(seed, 18)
        approach = np.resize([-1.0, 1.0], 18)
        errors = errors + 0.03 * approach
        cell = compared(errors - errors.mean(), properties | {"approach of j3": approach})
        assert cell.places[0].name == "approach of j3" and cell.is_clear(cell.places[0])


def test_properties_with_the_same_bins_are_one_group_and_count_once():
    errors, _ = clean(1, 12)
    j2, j3 = np.random.default_rng(2).normal(size=(2, 12))
    alone = compared(errors, {"j2": j2, "j3": j3})
    cell = compared(errors, {"j2": j2, "torque 2_2": -3 * j2, "j3": j3, "torque 2_3": 2 * j2})
    names = {tuple(t.name for t in group) for group in cell.groups}
    assert names == {("j2", "torque 2_2", "torque 2_3"), ("j3",)}
    assert cell.means == alone.means == 12
    tables = {t["name"]: t for t in comparison_document(cell)["tables"]}
    assert tables["torque 2_2"]["same_bins"] == ["j2", "torque 2_3"] and tables["j3"]["same_bins"] == []


def test_a_bin_and_all_outside_of_it_are_one_mean():
    errors, _ = clean(1, 12)
    assert compared(errors, {"approach of j1": np.resize([-1.0, 1.0], 12)}).means == 1


def test_the_two_ways_to_come_are_two_bins():
    _, bins = equal_count_bins(np.array([0.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0]))
    assert bins.tolist() == [1, 0, 2, 2, 0, 2, 2]
    edges, bins = equal_count_bins(np.array([1.0, -1.0, 1.0]))
    assert edges.tolist() == [-1.0, 0.0, 1.0] and bins.tolist() == [1, 0, 1]


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("approach of j1", [0.0, 0.0, 0.0], False),
        ("approach of j1", [0.0, 1.0, 1.0], False),
        ("approach of j1", [0.0, 1.0, -1.0], True),
        ("humidity_percent", [40.0, 40.0, 40.0], False),
        ("humidity_percent", [0.0, 40.0, 40.0], True),
    ],
)
def test_what_does_not_change_is_left_out(name, values, expected):
    assert property_varies(name, np.array(values)) is expected
