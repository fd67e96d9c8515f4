"""What `stitch compare` does: the residual against everything known of it, into the run folder and for people."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table as Printed

from stitch.cli.terminal.streams import emit
from stitch.comparison.compare_surfaces import compare
from stitch.comparison.compare_targets import compare_targets
from stitch.comparison.tables import PLACE, Comparison, Table, comparison_document
from stitch.runs.state import State
from stitch.stored.load_state import load_state
from stitch.system.console import console
from stitch.units import MICROMETRES, length_text
from stitch.writing.json_file import to_json, write_json
from stitch.writing.run_folder import extend, held

_WORST = 5
_SHOWN = 4


def compared_run(run: Path, effects_file: Path | None, *, trust: bool, as_json: bool) -> None:
    """Compare a run and show what was found.

    Raises:
        InputError, NoResultError: as `stitch compare` ends.
    """
    with held(run):
        state = load_state(run, effects_file, trust=trust)
        found = write_comparison(state, run)
    if as_json:
        emit(to_json(comparison_document(found)))
    else:
        show_comparison(found, state, run)


def show_comparison(found: Comparison, state: State, run: Path) -> None:
    """The clearest tables, for people."""
    to_um = MICROMETRES[state.session.length_unit]
    terminal = console()
    what = "between the views" if state.measurement.capture.scans else "from the targets to their place (3D)"
    terminal.print(f"{length_text(found.rms, state.session.length_unit)} rms {what} under the model.")
    for table in found.labelled:
        _worst(terminal, table, _named(table, state), to_um)
    for table in found.places[:_SHOWN]:
        _one(terminal, table, to_um)
    rest = ", ".join(f"{t.name} ({t.clearest:.1f})" for t in found.places[_SHOWN:])
    terminal.print(f"Less clear (largest mean over its σ): {rest}.", soft_wrap=True)
    for file in ("compare.json", "pictures/compare.png"):
        if (run / file).exists():
            terminal.print(f"  {run / file}")


def write_comparison(state: State, run: Path) -> Comparison:
    """compare.json and what other packages make of it."""
    found = compare(state) if state.measurement.capture.scans else compare_targets(state)
    write_json(comparison_document(found), run / "compare.json")
    extend("stitch.comparison_reports", found, state, run)
    return found


def _named(table: Table, state: State) -> str:
    """What the rows are; of places, in which unit and frame they are written."""
    if table.name != PLACE:
        return table.name
    frame = "base" if state.session.mount == "eye_in_hand" else "flange"
    return f"{table.name}, (x, y, z) in {state.session.length_unit} in the frame of the {frame}"


def _worst(terminal: Console, table: Table, name: str, to_um: float) -> None:
    told = ", ".join(
        f"{table.label[i]} {table.rms[i] * to_um:.1f}"
        + (f" ± {table.rms_sigma[i] * to_um:.1f}" if np.isfinite(table.rms_sigma[i]) else "")
        for i in table.worst(_WORST)
    )
    terminal.print(f"Worst by {name} (µm rms): {told}", soft_wrap=True)


def _one(terminal: Console, table: Table, to_um: float) -> None:
    unit = f" ({table.unit})" if table.unit else ""
    printed = Printed(
        title=f"By {table.name}{unit}: clearest mean {table.clearest:.1f} σ from zero", title_justify="left"
    )
    for heading in ("from", "to", "mean (µm)", "± 1 σ", "rms (µm)", "count", "views"):
        printed.add_column(heading, justify="right")
    for i in range(len(table.count)):
        between = [f"{table.low[i]:.4g}", f"{table.high[i]:.4g}"]
        amounts = [f"{x * to_um:{form}}" for x, form in _amounts(table, i)]
        printed.add_row(*between, *amounts, str(int(table.count[i])), str(int(table.views[i])))
    terminal.print(printed)


def _amounts(table: Table, i: int) -> list[tuple[float, str]]:
    """Mean, its sigma and rms of one row, with the form in which each is printed."""
    return [(table.mean[i], "+.1f"), (table.mean_sigma[i], ".1f"), (table.rms[i], ".1f")]
