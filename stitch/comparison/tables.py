"""Tables of a residual against everything that is known of it, and their document."""

from dataclasses import dataclass, field

import numpy as np

from stitch.frames import Array, Indices
from stitch.measurement.views import Views

PLACE = "place on the part"
_BINS = 6
_ENDINGS = {"_c": "°C", "_percent": "%", "_s": "s", "_mm": "mm", "_deg": "°"}
_FAIR = 50  # correspondences of a bin that may be called the worst


@dataclass(frozen=True)
class Table:
    """One property in bins; lengths in length_unit, counts of correspondences and of views."""

    name: str
    unit: str
    low: Array  # (B,) edges, or the number of the view or cell
    high: Array  # (B,)
    label: tuple[str, ...]  # (B,) names of views, pairs or cells; else empty
    mean: Array  # (B,) signed
    mean_sigma: Array
    rms: Array  # (B,)
    rms_sigma: Array
    count: Array
    views: Array

    @property
    def clearest(self) -> float:
        """Largest |mean| over its standard error; 0 where nothing is known."""
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.abs(self.mean) / self.mean_sigma
        return float(np.nanmax(np.where(np.isfinite(z), z, 0.0), initial=0.0))

    def worst(self, at_most: int) -> list[int]:
        """Numbers of the bins of largest rms, of those with a fair count."""
        fair = self.count > np.minimum(_FAIR, np.median(self.count) / 4)
        return [int(i) for i in np.argsort(-np.nan_to_num(self.rms), kind="stable") if fair[i]][:at_most]


@dataclass(frozen=True)
class Comparison:
    """All tables, and the rms they share."""

    tables: tuple[Table, ...]
    rms: float
    scale: float
    views: tuple[str, ...] = ()  # names, V
    of_views: dict[str, Array] = field(default_factory=dict)  # property -> (V,) value of each view

    def table(self, name: str) -> Table:
        """One table by its name."""
        return next(t for t in self.tables if t.name == name)

    @property
    def labelled(self) -> tuple[Table, ...]:
        """Tables by name: views, pairs, places, targets."""
        return tuple(t for t in self.tables if t.label)

    @property
    def places(self) -> tuple[Table, ...]:
        """Tables of properties, clearest dependence first."""
        own = [t for t in self.tables if not t.label]
        return tuple(sorted(own, key=lambda t: -t.clearest))


def view_properties(views: Views) -> list[tuple[str, str, Array]]:
    """Name, unit and value (V,) of everything that is known of the views."""
    out = [(f"j{i + 1}", "deg", np.degrees(views.joints[:, i])) for i in range(views.joints.shape[1])]
    out += [(f"approach of j{i + 1}", "", views.approach[:, i]) for i in range(views.approach.shape[1])]
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


def binned(values: Array) -> tuple[Array, Indices]:
    """(B + 1,) edges of bins with about equal counts, and the bin of every value (N,); equal values stay together."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, _BINS + 1)))
    edges = edges if len(edges) > 1 else np.array([edges[0] - 0.5, edges[0] + 0.5])
    bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return edges, bins.astype(np.int64)


def comparison_document(found: Comparison) -> dict[str, object]:
    """The tables as plain lists."""
    floats, counts = "low high mean mean_sigma rms rms_sigma", "count views"
    return {
        "rms": found.rms,
        "tables": [
            {"name": t.name, "unit": t.unit, "label": list(t.label), "clearest": t.clearest}
            | {key: getattr(t, key).tolist() for key in floats.split()}
            | {key: getattr(t, key).astype(int).tolist() for key in counts.split()}
            for t in found.tables
        ],
        "views": [
            {"view": name, "values": {key: float(values[v]) for key, values in found.of_views.items()}}
            for v, name in enumerate(found.views)
        ],
    }
