"""Measured features as plain data, as CSV and as characteristics of a DFQ file."""

import csv
import io
from typing import Any

import numpy as np

from stitch.plugins.metrology.budget import COVERAGE_FACTOR, MeasuredFeatures, Number
from stitch.plugins.metrology.error_sources import NOT_INCLUDED
from stitch.plugins.watch.dfq_file import Characteristic

MEASURE_FORMAT = "stitch-measure/1"


def measure_document(measured: MeasuredFeatures, run: str = "") -> dict[str, Any]:
    """Return features.json: all numbers with their budgets, and the covariance of all of them together."""
    trials = measured.checked
    ratios = [None] * len(measured.numbers) if trials is None else trials.ratio.tolist()
    return {
        "format": MEASURE_FORMAT,
        "run": run,
        "length_unit": measured.length_unit,
        "k": COVERAGE_FACTOR,
        "numbers": [_number(n, ratio) for n, ratio in zip(measured.numbers, ratios, strict=True)],
        "covariance": {"numbers": [n.name for n in measured.numbers], "matrix": measured.covariance.tolist()},
        "T_datum_reference": None if (T := measured.T_datum_reference) is None else T.tolist(),
        "trials": None if trials is None else trials.trials,
        "not_measured": measured.not_measured,
        "not_included": list(NOT_INCLUDED),
    }


def _number(n: Number, ratio: float | None) -> dict[str, Any]:
    return {
        "feature": n.feature.name,
        "kind": n.feature.kind,
        "at": None if n.feature.kind == "distance" else n.feature.at.tolist(),
        "normal": n.feature.axis.tolist() if n.feature.kind in ("point", "plane", "deviation") else None,
        "quantity": n.quantity,
        "unit": n.unit,
        "value": n.value,
        "nominal": n.nominal,
        "u": n.u,
        "U": n.U,
        "degrees_of_freedom": n.degrees,
        "limits": None if n.limits is None else list(n.limits),
        "conforms": n.conforms,
        "points": n.points,
        "form_95": n.form,
        "budget": [
            {"source": source, "variance_share": share, "u": n.u * float(np.sqrt(share)), "unit": n.unit}
            for source, share in n.shares.items()
        ],
        "monte_carlo_over_propagation": ratio,
    }


def measure_csv(measured: MeasuredFeatures) -> str:
    """Return a table with a row a number: a column a source, its standard uncertainty in the number's unit, and a
    column a number, the covariance with that in the product of both units."""
    sources = sorted({source for n in measured.numbers for source in n.shares})
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    columns = "feature kind quantity unit value nominal u k U degrees_of_freedom lower upper conforms points form_95"
    write.writerow(
        [*columns.split(), *(f"u: {source}" for source in sources), *(f"cov: {n.name}" for n in measured.numbers)]
    )
    for n, covariance in zip(measured.numbers, measured.covariance, strict=True):
        limits = n.limits or ("", "")
        conforms = {True: "yes", False: "no", None: "open" if n.limits else ""}[n.conforms]
        numbers = [_text(x) for x in (n.value, n.nominal, n.u, COVERAGE_FACTOR, n.U, n.degrees)]
        head = [n.feature.name, n.feature.kind, n.quantity, n.unit, *numbers, *map(_text, limits), conforms, n.points]
        by_source = [n.u * np.sqrt(n.shares.get(s, 0.0)) for s in sources]
        write.writerow([*head, *map(_text, (n.form, *by_source, *covariance))])
    return out.getvalue()


def _text(x: float | str) -> str:
    """A number with nine digits; empty where there is none."""
    return x if isinstance(x, str) else "" if not np.isfinite(x) else f"{x:.9g}"


def characteristics(measured: MeasuredFeatures) -> list[Characteristic]:
    """Return what a DFQ file says of the numbers."""
    return [Characteristic(n.name, n.unit, n.nominal, *(n.limits or (np.nan, np.nan))) for n in measured.numbers]
