"""`stitch compare RUN`: where model and measurement differ."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.cli.progress import opened_run, show_activity
from stitch.cli.terminal import emit, say, show_block, show_columns, show_files, show_next
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.diagnosis.dependence import Dependence
    from stitch.output.comparison.residual_tables import ResidualTable, ResidualTables
    from stitch.run_data import RunData

_SCOPE = "This look shows what the error follows, one covariate at a time. The cause is for stitch diagnose to name."
_WORST_ROWS = 5
_LISTED_TABLES = 4
_WITNESSES = ("open3d",)
_With = Annotated[
    str | None, typer.Option("--with", metavar="PROGRAM", help="Another program registers the same scans: open3d.")
]


def compare_run(
    run: RunFolder,
    program: _With = None,
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
      stitch compare runs/blade-17 --with open3d
    """
    if program is not None:
        _compare_with(program, run, effects_file, trust=trust, as_json=as_json)
        return
    from stitch.output.comparison.residual_tables import comparison_document
    from stitch.output.json_file import to_json

    with opened_run(run, effects_file, trust, "comparing: reading the scans") as state:
        comparison = write_comparison(state, run)
    if as_json:
        emit(to_json(comparison_document(comparison)))
    else:
        show_comparison(comparison, state, run)


def _compare_with(program: str, run: Path, effects_file: Path | None, *, trust: bool, as_json: bool) -> None:
    """Register the scans of a run with another program, print how its poses differ, and write witness.json.

    Raises:
        InputError: the program is not known, or not installed.
    """
    from stitch.numerics.units import angle_text, length_text
    from stitch.output import json_file, run_folder
    from stitch.output.comparison.open3d_witness import open3d_witness
    from stitch.system.open3d_library import import_open3d

    if program not in _WITNESSES:
        raise InputError(f"--with {program}: to fix: {' or '.join(_WITNESSES)}")
    import_open3d(f"--with {program}")
    with opened_run(run, effects_file, trust, "comparing: reading the scans") as state:
        with show_activity("comparing: Open3D registers the scans"):
            witness = open3d_witness(state)
        json_file.write_json(witness.document(), run / "witness.json")
        run_folder.call_entry_points("stitch.witness_pictures", witness, state, run)
    if as_json:
        emit(json_file.to_json(witness.document()))
        return
    unit = state.session.length_unit
    for sentence in witness.sentences(unit):
        say(sentence)
    columns = (
        ("view", lambda v: witness.views[v]),
        ("shift", lambda v: length_text(float(witness.shift[v]), unit)),
        ("turn", lambda v: angle_text(float(witness.turn[v]))),
    )
    show_columns("Open3D's pose of each view beside this run's", columns, range(len(witness.views)))
    show_files(run, ("witness.json", "witness.png"))


def write_comparison(state: RunData, run: Path) -> ResidualTables:
    """Return the tables of residuals of a run, after writing compare.json and the pages of installed packages."""
    from stitch.output import json_file, run_folder
    from stitch.output.comparison.residual_tables import compare_surfaces, compare_targets, comparison_document

    with show_activity("comparing: residuals by view, joint, time and place"):
        comparison = compare_surfaces(state) if state.measurement.capture.scans else compare_targets(state)
    with show_activity("comparing: drawing pictures and page"):
        json_file.write_json(comparison_document(comparison), run / "compare.json")
        run_folder.call_entry_points("stitch.comparison_reports", comparison, state, run)
    return comparison


def show_comparison(comparison: ResidualTables, state: RunData, run: Path) -> None:
    """Print what the residuals depend on, the worst views and places, and the `_LISTED_TABLES` clearest tables.

    Tables come in groups whose bins hold the same correspondences, the clearest first.

    Args:
        state: the run that was compared.
        run: its folder.
    """
    from stitch.numerics.units import MICROMETRES, length_text

    unit = state.session.length_unit
    to_um = MICROMETRES[unit]
    what = "between the views" if state.measurement.capture.scans else "from the targets to their place (3D)"
    _show_followed(comparison.followed, to_um)
    say(_significance_sentence(comparison), bold=not comparison.followed)
    worst = [(f"worst by {table.name}", _worst_rows(table, state, to_um)) for table in comparison.labelled]
    show_block([("under the model", f"{length_text(comparison.rms, unit)} rms {what}"), *worst])
    for group in comparison.groups[:_LISTED_TABLES]:
        _show_group(group, comparison, to_um)
    if rest := [_group_chance(comparison, group) for group in comparison.groups[_LISTED_TABLES:]]:
        say(f"Less clear (p = 1 where none is given): {'; '.join(rest)}.")
    show_files(run, ("compare.json",))
    command = "review" if (run / "diagnosis.json").exists() else "diagnose"
    show_next(f"Next: stitch {command} {shlex.quote(str(run))}")


def _show_followed(followed: Sequence[Dependence], to_um: float) -> None:
    """Print on which covariates the displacement of whole views depends, and its means along the clearest one.

    Args:
        followed: trends along covariates, the clearest first.
        to_um: micrometres per length_unit.
    """
    from stitch.diagnosis.dependence import also_clear, equally_clear

    if not followed:
        return
    first = followed[0]
    equal = equally_clear(followed)
    if first.clear:
        say(f"Whole views follow {' or '.join(map(_followed_text, equal))}.", bold=True)
    else:
        say(f"Whole views follow nothing known of them (clearest: {_followed_text(first)}).", bold=True)
    say(_SCOPE)
    if not first.clear:
        return
    further = also_clear(followed)
    if further:
        say(f"Beside that they follow {', '.join(f'{x.covariate} (p = {x.p_beside:.1g})' for x in further)}.")
    if idle := [x.covariate for x in followed if x.clear and x not in (*equal, *further)]:
        say(f"Alike, but not needed beside it: {', '.join(idle)}.")
    axis = ", ".join(f"{x:+.2f}" for x in first.direction)
    unit = f" ({first.unit})" if first.unit else ""
    columns = (
        (first.covariate, lambda i: f"{first.bins[i]:.4g}"),
        ("mean (µm)", lambda i: f"{first.mean[i] * to_um:+.1f}"),
        ("± 1 σ", lambda i: f"{first.sigma[i] * to_um:.1f}"),
    )
    title = f"Displacement at the part along ({axis}), by {first.covariate}{unit}"
    show_columns(title, columns, range(len(first.bins)), words=())


def _followed_text(x: Dependence) -> str:
    """Return a covariate with place and shape of its trend, and the chance: time_s (joint 2, a line, p = 3e-07)."""
    return f"{x.covariate} ({x.place}, {x.shape}, p = {x.p_value:.1g})"


def _significance_sentence(comparison: ResidualTables) -> str:
    """Return a sentence on which means of bins differ from zero, with p-values over all bins of all tables."""
    from stitch.output.comparison.residual_tables import CLEAR

    if not comparison.groups:
        return "Nothing that is known of the views changes from one to another."
    if not comparison.means:
        return "Nothing clear: the views are too few to say how well their means are known."
    clear = [_group_chance(comparison, group) for group in comparison.groups if comparison.is_clear(group[0])]
    if clear:
        return f"Single points, clear among {comparison.means} means of bins: {'; '.join(clear)}."
    return (
        f"Single points follow nothing clear: chance makes one of {comparison.means} means of bins as clear "
        f"({_chance_text(comparison, comparison.groups[0][0])}; clear is p ≤ {CLEAR}). "
        "Such means hide errors whose sign changes with the pose; whole views show them."
    )


def _group_chance(comparison: ResidualTables, group: Sequence[ResidualTable]) -> str:
    chance = f" ({_chance_text(comparison, group[0])})" if comparison.p_of_all(group[0]) < 1 else ""
    return _group_names(group) + chance


def _chance_text(comparison: ResidualTables, table: ResidualTable) -> str:
    """Return as text the probability that by chance any mean of all tables is as clear as this table's clearest."""
    p = comparison.p_of_all(table)
    return "p < 0.0001" if p < 1e-4 else f"p = {p:.2g}"


def _group_names(group: Sequence[ResidualTable]) -> str:
    """Return j2, torque 2_2 and torque 2_3: tables whose bins hold the same."""
    from stitch.numerics.units import listed

    return listed([table.name for table in group], "and")


def _worst_rows(table: ResidualTable, state: RunData, to_um: float) -> str:
    """Return the `_WORST_ROWS` rows of a table with the largest rms, in µm, as text.

    Labels of the table of places are coordinates: their unit and frame are added.

    Args:
        to_um: micrometres per length_unit.
    """
    from stitch.output.comparison.residual_tables import PLACE

    worst = ", ".join(
        f"{table.label[i]} {table.rms[i] * to_um:.1f}"
        + (f" ± {table.rms_sigma[i] * to_um:.1f}" if isfinite(table.rms_sigma[i]) else "")
        for i in table.worst(_WORST_ROWS)
    )
    if table.name != PLACE:
        return f"{worst} µm rms"
    frame = "base" if state.session.mount == "eye_in_hand" else "flange"
    return f"{worst} µm rms; (x, y, z) in {state.session.length_unit} in the frame of the {frame}"


def _show_group(group: Sequence[ResidualTable], comparison: ResidualTables, to_um: float) -> None:
    """Print one table for a group of tables whose bins hold the same correspondences, with the edges of the first.

    Args:
        to_um: micrometres per length_unit.
    """
    table = group[0]
    unit = f" ({table.unit})" if table.unit else ""
    has = "has" if len(group) == 2 else "have"
    others = f"; {_group_names(group[1:])} {has} the same bins" if len(group) > 1 else ""
    clear = "" if comparison.is_clear(table) else ", not clear"
    columns = (
        ("from", lambda i: f"{table.low[i]:.4g}"),
        ("to", lambda i: f"{table.high[i]:.4g}"),
        ("mean (µm)", lambda i: f"{table.mean[i] * to_um:+.1f}"),
        ("± 1 σ", lambda i: f"{table.mean_sigma[i] * to_um:.1f}"),
        ("rms (µm)", lambda i: f"{table.rms[i] * to_um:.1f}"),
        ("count", lambda i: str(int(table.count[i]))),
        ("views", lambda i: str(int(table.views[i]))),
    )
    title = f"By {table.name}{unit}{others}: {_chance_text(comparison, table)} over all means{clear}"
    show_columns(title, columns, range(len(table.count)), words=())
