"""A comparison of views of known errors, by properties of the views."""

import numpy as np

from stitch.output.comparison.residual_tables import ResidualTables, binned_table, equal_count_bins, view_statistics


def compared(errors, properties, rms=1.0):
    """Of views that are off by `errors` (V,), each with 1000 rows, by properties name -> (V,)."""
    tables = []
    for name, values in properties.items():
        edges, bins = equal_count_bins(values)
        n = (bins == np.arange(len(edges) - 1)[:, None]) * 1000.0
        statistics = view_statistics(n, n * errors, n * errors**2)
        tables.append(binned_table(name, "deg", edges, statistics))
    return ResidualTables(tuple(tables), rms)
