"""`stitch compare RUN`: where model and measurement differ."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.cli.terminal import emit

if TYPE_CHECKING:
    from rich.console import Console

    from stitch.comparison.residual_tables import ResidualTable, ResidualTables
    from stitch.runs.run import Run


# What `stitch compare` does: the residual against everything known of it, into the run folder and for people.

_WORST_ROWS = 5
_LISTED_TABLES = 4


def run_compare(run: Path, effects_file: Path | None, *, trust: bool, as_json: bool) -> None:
    """Compare a run and show what was found.

    Raises:
        InputError, NoResultError: as `stitch compare` ends.
    """
    from stitch.comparison.residual_tables import comparison_document
    from stitch.stored.stored_run import load_run
    from stitch.writing.json_file import to_json
    from stitch.writing.run_folder import lock_run_folder

    with lock_run_folder(run):
        state = load_run(run, effects_file, trust=trust)
        found = write_comparison(state, run)
    if as_json:
        emit(to_json(comparison_document(found)))
    else:
        show_comparison(found, state, run)


def show_comparison(comparison: ResidualTables, state: Run, run: Path) -> None:
    """The clearest tables, for people."""
    from stitch.system.process import console
    from stitch.units import MICROMETRES, length_text

    to_um = MICROMETRES[state.session.length_unit]
    terminal = console()
    what = "between the views" if state.measurement.capture.scans else "from the targets to their place (3D)"
    terminal.print(f"{length_text(comparison.rms, state.session.length_unit)} rms {what} under the model.")
    for table in comparison.labelled:
        _show_worst_rows(terminal, table, _row_names(table, state), to_um)
    terminal.print(_significance_sentence(comparison), soft_wrap=True)
    for group in comparison.groups[:_LISTED_TABLES]:
        _show_table(terminal, group, comparison, to_um)
    if rest := [_group_chance(comparison, group) for group in comparison.groups[_LISTED_TABLES:]]:
        terminal.print(f"Less clear (p = 1 where none is given): {'; '.join(rest)}.", soft_wrap=True)
    if (run / "compare.json").exists():
        terminal.print(f"  {run / 'compare.json'}")
    terminal.print(_next_command(run), soft_wrap=True)


def write_comparison(state: Run, run: Path) -> ResidualTables:
    """compare.json and what other packages make of it."""
    from stitch.comparison.residual_tables import compare_surfaces, compare_targets, comparison_document
    from stitch.writing.json_file import write_json
    from stitch.writing.run_folder import call_entry_points

    found = compare_surfaces(state) if state.measurement.capture.scans else compare_targets(state)
    write_json(comparison_document(found), run / "compare.json")
    call_entry_points("stitch.comparison_reports", found, state, run)
    return found


def _significance_sentence(comparison: ResidualTables) -> str:
    """What the means of all bins say together; views are the samples."""
    from stitch.comparison.residual_tables import CLEAR

    if not comparison.groups:
        return "Nothing that is known of the views changes from one to another."
    if not comparison.means:
        return "Nothing clear: the views are too few to say how well their means are known."
    clear = [_group_chance(comparison, group) for group in comparison.groups if comparison.is_clear(group[0])]
    if clear:
        return f"Clear among {comparison.means} means of bins, p over all of them: {'; '.join(clear)}."
    return (
        f"Nothing clear: chance alone makes the clearest of {comparison.means} means of bins as clear as this one "
        f"({_chance_text(comparison, comparison.groups[0][0])}; clear is p ≤ {CLEAR}). "
        "Errors whose sign changes with the pose do not show in such means."
    )


def _group_chance(comparison: ResidualTables, group: Sequence[ResidualTable]) -> str:
    return _group_names(group) + (
        f" ({_chance_text(comparison, group[0])})" if comparison.p_of_all(group[0]) < 1 else ""
    )


def _chance_text(comparison: ResidualTables, table: ResidualTable) -> str:
    """How easily chance makes any of all means as clear as the clearest of a table."""
    p = comparison.p_of_all(table)
    return "p < 0.0001" if p < 1e-4 else f"p = {p:.2g}"


def _group_names(group: Sequence[ResidualTable]) -> str:
    """j2, torque 2_2 and torque 2_3: whose bins hold the same."""
    *others, last = [table.name for table in group]
    return f"{', '.join(others)} and {last}" if others else last


def _next_command(run: Path) -> str:
    """The command that most would type now."""
    folder = shlex.quote(str(run))
    return f"Next: stitch {'review' if (run / 'diagnosis.json').exists() else 'diagnose'} {folder}"


def _row_names(table: ResidualTable, state: Run) -> str:
    """What the rows are; of places, in which unit and frame they are written."""
    from stitch.comparison.residual_tables import PLACE

    if table.name != PLACE:
        return table.name
    frame = "base" if state.session.mount == "eye_in_hand" else "flange"
    return f"{table.name}, (x, y, z) in {state.session.length_unit} in the frame of the {frame}"


def _show_worst_rows(terminal: Console, table: ResidualTable, name: str, to_um: float) -> None:
    import numpy as np

    told = ", ".join(
        f"{table.label[i]} {table.rms[i] * to_um:.1f}"
        + (f" ± {table.rms_sigma[i] * to_um:.1f}" if np.isfinite(table.rms_sigma[i]) else "")
        for i in table.worst(_WORST_ROWS)
    )
    terminal.print(f"Worst by {name} (µm rms): {told}", soft_wrap=True)


def _show_table(terminal: Console, group: Sequence[ResidualTable], comparison: ResidualTables, to_um: float) -> None:
    """One table for all properties whose bins hold the same, with the edges of the first."""
    from rich.table import Table as Printed

    table = group[0]
    unit = f" ({table.unit})" if table.unit else ""
    others = (
        f"; {_group_names(group[1:])} {'has' if len(group) == 2 else 'have'} the same bins" if len(group) > 1 else ""
    )
    clear = "" if comparison.is_clear(table) else ", not clear"
    printed = Printed(
        title=f"By {table.name}{unit}{others}: {_chance_text(comparison, table)} over all means{clear}",
        title_justify="left",
    )
    for heading in ("from", "to", "mean (µm)", "± 1 σ", "rms (µm)", "count", "views"):
        printed.add_column(heading, justify="right")
    for i in range(len(table.count)):
        between = [f"{table.low[i]:.4g}", f"{table.high[i]:.4g}"]
        amounts = [f"{x * to_um:{form}}" for x, form in _row_amounts(table, i)]
        printed.add_row(*between, *amounts, str(int(table.count[i])), str(int(table.views[i])))
    terminal.print(printed)


def _row_amounts(table: ResidualTable, i: int) -> list[tuple[float, str]]:
    """Mean, its sigma and rms of one row, with the form in which each is printed."""
    return [(table.mean[i], "+.1f"), (table.mean_sigma[i], ".1f"), (table.rms[i], ".1f")]


def compare_run(
    run: RunFolder,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Show the residual by view, pair, target, joint, range, incidence, field, time, covariate and place.

    Views are the samples. What follows a property clearly is told with the chance of it over all bins that were asked.

    \b
    Examples:
      stitch compare runs/blade-17
      stitch compare runs/blade-17 --json
    """

    run_compare(run, effects_file, trust=trust, as_json=as_json)
