"""`stitch compare RUN`: where model and measurement differ."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table as Printed

from stitch.comparison.compare_surfaces import compare
from stitch.comparison.compare_targets import compare_targets
from stitch.comparison.tables import Comparison, Table, comparison_document
from stitch.stored.load_state import State, load_state
from stitch.units import MICROMETRES
from stitch.writing.json_file import to_json, write_json
from stitch.writing.run_folder import extend

_WORST = 5
_SHOWN = 4


def compare_run(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print all tables as JSON.")] = False,
) -> None:
    """Show the residual by view, pair, target, joint, range, incidence, field, time, covariate and place."""
    state = load_state(run, thin=True)
    found = write_comparison(state, run)
    if as_json:
        print(to_json(comparison_document(found)))
        return
    to_um = MICROMETRES[state.session.length_unit]
    console = Console(stderr=True)
    what = "between the views" if state.measurement.capture.scans else "from the targets to their place (3D)"
    console.print(f"{found.rms * to_um:.1f} µm rms {what} under the model.", highlight=False)
    for table in found.labelled:
        _worst(console, table, to_um)
    for table in found.places[:_SHOWN]:
        _one(console, table, to_um)
    rest = ", ".join(f"{t.name} ({t.clearest:.1f})" for t in found.places[_SHOWN:])
    console.print(f"Less clear (largest mean over its sigma): {rest}.", soft_wrap=True, highlight=False)
    for file in ("compare.json", "pictures/compare.png"):
        if (run / file).exists():
            console.print(f"  {run / file}", highlight=False)


def write_comparison(state: State, run: Path) -> Comparison:
    """compare.json and what other packages make of it."""
    found = compare(state) if state.measurement.capture.scans else compare_targets(state)
    write_json(comparison_document(found), run / "compare.json")
    extend("stitch.comparison_reports", found, state, run)
    return found


def _worst(console: Console, table: Table, to_um: float) -> None:
    told = ", ".join(
        f"{table.label[i]} {table.rms[i] * to_um:.1f}"
        + (f" ± {table.rms_sigma[i] * to_um:.1f}" if np.isfinite(table.rms_sigma[i]) else "")
        for i in table.worst(_WORST)
    )
    console.print(f"Worst by {table.name} (µm rms): {told}", soft_wrap=True, highlight=False)


def _one(console: Console, table: Table, to_um: float) -> None:
    unit = f" ({table.unit})" if table.unit else ""
    printed = Printed(title=f"{table.name}{unit}: clearest mean {table.clearest:.1f} sigma", title_justify="left")
    for heading in ("from", "to", "mean (µm)", "± ", "rms (µm)", "count", "views"):
        printed.add_column(heading, justify="right")
    for i in range(len(table.count)):
        printed.add_row(
            f"{table.low[i]:.4g}", f"{table.high[i]:.4g}", f"{table.mean[i] * to_um:+.1f}",
            f"{table.mean_sigma[i] * to_um:.1f}", f"{table.rms[i] * to_um:.1f}", str(int(table.count[i])),
            str(int(table.views[i])),
        )  # fmt: skip
    console.print(printed)
