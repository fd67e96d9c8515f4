"""`stitch measure RUN FEATURES.toml`: features of the part with U, and which source brings how much of it."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, say, show_block, show_files, show_next, show_table, stdout_for_results
from stitch.errors import InputError

if TYPE_CHECKING:
    from stitch.plugins.metrology.budget import MeasuredFeatures, Number

_SOURCES = 3  # that are shown of a budget
_FEWEST_TRIALS = 200


@stdout_for_results
def measure(
    run: RunFolder,
    features: Annotated[
        Path | None, typer.Argument(metavar="FEATURES.toml", help="What to measure; without it, sigma of every point.")
    ] = None,
    trials: Annotated[
        int, typer.Option("--monte-carlo", metavar="N", help="Also draw N trials of all sources (JCGM 101).")
    ] = 0,
    dfq: Annotated[Path | None, typer.Option("--dfq", metavar="FILE", help="Also write the values as Q-DAS.")] = None,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Measure points, planes, spheres, cylinders, circles, distances and deviations from CAD, each with its U.

    Without FEATURES.toml, stitched.ply gets a column `sigma`: how far each point may lie off along its normal.

    \b
    Examples:
      stitch measure runs/blade-17 blade.toml
      stitch measure runs/blade-17 blade.toml --monte-carlo 4000 --dfq blade.dfq
    """
    from stitch.output.json_file import to_json, write_json
    from stitch.output.run_folder import call_entry_points, lock_run_folder
    from stitch.output.stored_run import load_run
    from stitch.plugins.metrology.budget import measure_csv, measure_document
    from stitch.plugins.metrology.error_sources import place_errors
    from stitch.plugins.metrology.place_errors import point_sigmas, write_sigmas
    from stitch.plugins.metrology.verb import measure as measure_run
    from stitch.system.files import whole_file

    _require_measure_options(features, trials, dfq)
    with lock_run_folder(run), show_activity("measuring: reading the scans"):
        state = load_run(run, effects_file, trust=trust)
        if features is None:
            sigma = point_sigmas(place_errors(state), state.fused)
            write_sigmas(run / "stitched.ply", sigma)
            say(f"stitched.ply has the column sigma for {len(sigma):,} points.")
            return
        measured = measure_run(state, features, trials=trials)
        document = measure_document(measured, str(run))
        write_json(document, run / "features.json")
        with whole_file(run / "features.csv") as file:
            file.write_text(measure_csv(measured), encoding="utf-8")
        call_entry_points("stitch.measure_pages", document, run / "features.html")
        if dfq is not None:
            _write_dfq(measured, state.session.name, run, dfq)
    if as_json:
        emit(to_json(document))
        return
    _show_numbers(measured)
    show_files(run, ("features.json", "features.csv", "features.html"))
    show_next(f"Next: stitch verify {shlex.quote(str(run))} ARTEFACT")


def _require_measure_options(features: Path | None, trials: int, dfq: Path | None) -> None:
    if trials and trials < _FEWEST_TRIALS:
        raise InputError(f"--monte-carlo {trials}: to fix: draw {_FEWEST_TRIALS} trials or more, or none")
    if features is None and (trials or dfq is not None):
        raise InputError("--monte-carlo and --dfq: to fix: name FEATURES.toml after RUN")
    if dfq is not None and (dfq.suffix.lower() != ".dfq" or not dfq.parent.is_dir()):
        raise InputError(f"--dfq {dfq}: to fix: name a file that ends in .dfq, in a folder that exists")


def _write_dfq(measured: MeasuredFeatures, part: str, run: Path, file: Path) -> None:
    from stitch.plugins.metrology.budget import characteristics
    from stitch.plugins.watch.dfq_file import dfq_text
    from stitch.system.files import whole_file

    time = (run / "result.json").stat().st_mtime
    text = dfq_text(part, characteristics(measured), [(time, [n.value for n in measured.numbers])])
    with whole_file(file) as scratch:
        scratch.write_bytes(text.encode("utf-8-sig"))


def _show_numbers(measured: MeasuredFeatures) -> None:
    from stitch.plugins.metrology.error_sources import NOT_INCLUDED
    from stitch.plugins.metrology.verification import agreeing, verified_numbers

    title = f"Numbers with U (k = 2), {measured.length_unit} and rad"
    rows = [
        (n.name, f"{n.value:.5g}", f"{n.value - n.nominal if n.u else 0.0:.2g}", f"{n.U:.2g}", _budget_text(n))
        for n in measured.numbers
    ]
    if measured.T_datum_reference is not None:
        say("Numbers count in the frame of the datum, T_datum_reference in features.json.")
    show_table(title, ("number", "value", "off nominal", "U", "most of U"), rows, words=("number", "most of U"))
    if (checked := measured.checked) is not None:
        low, high = float(checked.ratio.min()), float(checked.ratio.max())
        say(f"Monte Carlo over propagation, {checked.trials:,} trials: {low:.3f} to {high:.3f}.")
    numbers = verified_numbers(measured)
    if numbers:
        say(f"{agreeing(numbers)} of {len(numbers)} calibrated numbers agree within U and that of their calibration.")
    show_block([("not measured", text) for text in measured.not_measured.values()])
    show_block([("not in U", text) for text in NOT_INCLUDED])


def _budget_text(n: Number) -> str:
    """The largest sources of a number, and whether it keeps its tolerance."""
    largest = [f"{source} {100 * share:.0f} %" for source, share in list(n.shares.items())[:_SOURCES] if share > 0.05]
    verdict = {True: "; conforms", False: "; does not conform", None: "; U reaches over a limit" if n.limits else ""}
    return (", ".join(largest) if n.u else "datum") + verdict[n.conforms]
