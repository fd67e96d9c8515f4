"""Tables of a residual against everything that is known of it, and their document."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from stitch.comparison.same_bins import group_same_bins
from stitch.comparison.table import ResidualTable
from stitch.frames import Array, Indices
from stitch.measurement.views import Views

PLACE = "place on the part"
APPROACH = "approach of j"
_SAME_VALUE = 1e-9  # numbers closer than that are one
_BINS = 6
_ENDINGS = {"_c": "°C", "_percent": "%", "_s": "s", "_mm": "mm", "_deg": "°"}
CLEAR = 0.05  # p over all means


@dataclass(frozen=True)
class ResidualTables:
    """All tables, and the rms they share."""

    tables: tuple[ResidualTable, ...]
    rms: float
    scale: float
    views: tuple[str, ...] = ()  # names, V
    of_views: dict[str, Array] = field(default_factory=dict)  # property -> (V,) value of each view

    def table(self, name: str) -> ResidualTable:
        """One table by its name."""
        return next(t for t in self.tables if t.name == name)

    @property
    def labelled(self) -> tuple[ResidualTable, ...]:
        """Tables by name: views, pairs, places, targets."""
        return tuple(t for t in self.tables if t.label)

    @cached_property
    def groups(self) -> tuple[tuple[ResidualTable, ...], ...]:
        """Tables of properties, clearest dependence first; those whose bins hold the same rows together."""
        own = group_same_bins([t for t in self.tables if not t.label])
        return tuple(sorted(own, key=lambda g: (g[0].least_p, -g[0].clearest)))

    @property
    def places(self) -> tuple[ResidualTable, ...]:
        """The first table of every group, clearest dependence first."""
        return tuple(group[0] for group in self.groups)

    @cached_property
    def means(self) -> int:
        """How many means of bins are asked whether they are zero.

        Bins of the same rows count once in whichever table they stand, and so do a bin and all that lies outside it:
        the sums of the two differ in their sign alone.
        """
        sums = [np.abs(t.mean * t.count)[np.isfinite(t.p_value)] for t in self.places]
        ordered = np.sort(np.concatenate(sums)) if sums else np.zeros(0)
        return len(ordered) and 1 + int((np.diff(ordered) > _SAME_VALUE * ordered[-1]).sum())

    def p_of_all(self, table: ResidualTable) -> float:
        """That chance makes any of all the means as clear as the clearest of this table (Bonferroni)."""
        return min(1.0, max(self.means, 1) * table.least_p)

    def is_clear(self, table: ResidualTable) -> bool:
        """True where chance does not explain its clearest mean (5 % over all means)."""
        return self.p_of_all(table) <= CLEAR


def view_properties(views: Views) -> list[tuple[str, str, Array]]:
    """Name, unit and value (V,) of everything that is known of the views."""
    out = [(f"j{i + 1}", "deg", np.degrees(views.joints[:, i])) for i in range(views.joints.shape[1])]
    out += [(f"{APPROACH}{i + 1}", "", views.approach[:, i]) for i in range(views.approach.shape[1])]
    out += [(f"torque {n}", "N m", views.torques.values[:, i]) for i, n in enumerate(views.torques.names)]
    if views.has("time"):
        out.append(("time", "s", views.time))
    return out + [(name, _unit_of(name), values) for name, values in views.covariates.items()]


def _unit_of(covariate: str) -> str:
    """As the name says it: scanner_temperature_c, humidity_percent."""
    return next((unit for ending, unit in _ENDINGS.items() if covariate.endswith(ending)), "")


def values_of_views(views: Views) -> dict[str, Array]:
    """Property -> (V,) value of each view; as `view_properties`."""
    return {name: values for name, _, values in view_properties(views)}


def property_varies(name: str, values: Array) -> bool:
    """True if a property (V,) has two values; that no view came before the first is no approach."""
    told = values[values != 0] if name.startswith(APPROACH) else values
    return bool(len(told) and np.ptp(told) > _SAME_VALUE)


def equal_count_bins(values: Array) -> tuple[Array, Indices]:
    """(B + 1,) edges of bins with about equal counts, and the bin of every value (N,); equal values stay together.

    Of no more values than bins, each has its own.
    """
    own = np.unique(values)
    if len(own) <= _BINS:
        edges = np.concatenate([own[:1], (own[1:] + own[:-1]) / 2, own[-1:]])
    else:
        edges = np.unique(np.quantile(values, np.linspace(0, 1, _BINS + 1)))
    edges = edges if len(own) > 1 else np.array([own[0] - 0.5, own[0] + 0.5])
    bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return edges, bins.astype(np.int64)


def comparison_document(found: ResidualTables) -> dict[str, object]:
    """The tables as plain lists."""
    floats, counts = "low high mean mean_sigma rms rms_sigma p_value", "count views"
    names = {t.name: [x.name for x in group if x is not t] for group in found.groups for t in group}
    return {
        "rms": found.rms,
        "means": found.means,
        "tables": [
            {"name": t.name, "unit": t.unit, "label": list(t.label), "clearest": t.clearest}
            | ({} if t.label else {"p_of_all": found.p_of_all(t), "same_bins": names[t.name]})
            | {key: getattr(t, key).tolist() for key in floats.split()}
            | {key: getattr(t, key).astype(int).tolist() for key in counts.split()}
            for t in found.tables
        ],
        "views": [
            {"view": name, "values": {key: float(values[v]) for key, values in found.of_views.items()}}
            for v, name in enumerate(found.views)
        ],
    }
