"""Properties whose bins hold the same rows: they say one thing under several names."""

from collections.abc import Sequence

import numpy as np

from stitch.comparison.table import ResidualTable

# Of the size of the largest mean: sums of the same rows in another order differ by rounding.
_ROUNDING = 1e-6


def group_same_bins(tables: Sequence[ResidualTable]) -> tuple[tuple[ResidualTable, ...], ...]:
    """Tables in groups whose bins hold the same rows, in whichever order; groups and tables as they come."""
    groups: list[list[ResidualTable]] = []
    for table in tables:
        group = next((g for g in groups if _same_rows(g[0], table)), None)
        if group is None:
            groups.append([table])
        else:
            group.append(table)
    return tuple(tuple(g) for g in groups)


def _same_rows(a: ResidualTable, b: ResidualTable) -> bool:
    if len(a.count) != len(b.count):
        return False
    first, second = (np.lexsort((np.nan_to_num(t.rms), np.nan_to_num(t.mean), t.count)) for t in (a, b))
    if not np.array_equal(a.count[first], b.count[second]):
        return False
    small = _ROUNDING * float(np.nanmax(a.rms, initial=0.0))
    pairs = ((a.mean, b.mean), (a.rms, b.rms))
    return all(np.allclose(x[first], y[second], rtol=0, atol=small, equal_nan=True) for x, y in pairs)
