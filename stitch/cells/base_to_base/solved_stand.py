"""What `stitch base` does: a stand solved, shown, drawn, and as a session."""

import json
from pathlib import Path

import numpy as np
from rich.table import Table

from stitch import frames
from stitch.cells.base_to_base import rod_session
from stitch.cells.base_to_base.stand_file import read_stand
from stitch.cells.base_to_base.stand_solution import BaseResult, base_document, comparison_text, solve_stand
from stitch.cells.outputs import write_recording_and_page
from stitch.errors import NoResultError
from stitch.system.console import console
from stitch.writing.session_files import write_session


def run_base(file: Path, recording: Path | None, report: Path | None, session: Path | None, as_json: bool) -> None:
    """Solve a stand and hand out what was asked for.

    Raises:
        InputError, NoResultError: as `stitch base` ends.
    """
    stand = read_stand(file)
    try:
        result = solve_stand(stand)
    except NoResultError:
        # The page shows which readings contradict each other.
        write_recording_and_page("base", None, report, stand, None)
        raise
    if session is not None:
        write_session(session, rod_session.rod_session(stand, result))
    write_recording_and_page("base", recording, report, stand, result)
    if as_json:
        print(json.dumps(base_document(result), indent=1))
    else:
        _print_solution(result)


def _print_solution(result: BaseResult) -> None:
    terminal = console()
    unit, solution = result.length_unit, result.fit
    table = Table(title="T_base1_base2, translation and turn about the axes of base 1", title_justify="left")
    for heading in ("solution", f"x y z / {unit}", "rotation vector / rad"):
        table.add_column(heading)
    table.add_row("least squares", *_pose_cells(solution.T_base1_base2))
    table.add_row("  1 σ", _number_text(solution.sigma[3:], 5), _number_text(solution.sigma[:3], 6))
    if result.projection is not None:
        table.add_row("projection", *_pose_cells(result.projection.T_base1_base2))
    terminal.print(table)
    terminal.print(
        f"chi-square {solution.chi_square:.2f} with {solution.redundancy} redundant readings, p = "
        f"{solution.p_value:.2g}."
    )
    for comparison in result.comparisons:
        terminal.print(comparison_text(comparison, unit) + ".")
    if result.no_projection:
        terminal.print(f"No projection: {result.no_projection}.")
    for row in solution.T_base1_base2:
        print(" ".join(f"{value:.9g}" for value in row))


def _pose_cells(T: np.ndarray) -> tuple[str, str]:
    return _number_text(T[:3, 3], 5), _number_text(frames.log(T)[:3], 6)


def _number_text(values: np.ndarray, digits: int) -> str:
    return "  ".join(f"{value:.{digits}f}" for value in np.round(values, digits) + 0.0)
