"""The commands of the other measuring systems: `stitch base`, `drill`, `panel`, `fit`, `seam`.

Each imports its system when it runs, so that its help waits for no mathematics.
"""

from pathlib import Path
from typing import Annotated

import typer

from stitch.system.process import tell_seconds

JobFile = Annotated[Path, typer.Argument(metavar="JOB", help="Job file, TOML.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON alone on standard output.")]
RecordingOption = Annotated[
    Path | None, typer.Option("--recording", metavar="FILE", help="Write a Rerun recording, .rrd.")
]
ReportOption = Annotated[Path | None, typer.Option("--report", metavar="FILE", help="Write one page, .html.")]
SessionOption = Annotated[
    Path | None,
    typer.Option("--session", metavar="FOLDER", help="Write the readings as a session for `stitch run` and diagnose."),
]


def base(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Readings of the stand, TOML.")],
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the transform between two robot bases from a stand with a measuring rod.

    \b
    Examples:
      stitch base stand.toml --report page.html
    """
    from stitch.plugins.cells.base_to_base import run_base
    from stitch.plugins.cells.job_files import Wanted

    with tell_seconds("base: the transform between both robots"):
        run_base(file, Wanted(None, recording, report, session, as_json))


def drill(
    file: JobFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="CSV", help="Write the drives.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    servo: Annotated[
        str | None,
        typer.Option(
            "--servo",
            metavar="COMMAND",
            help="Moves the robot to a pose (JSON on its standard input) and prints what rangers and camera see.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Correct the drives of holes from reference holes that the robot has seen, or drives onto now.

    \b
    Examples:
      stitch drill job.toml --report page.html
      stitch drill job.toml -o drives.csv --servo "./drive-and-read"
    """
    from stitch.plugins.cells.drilling import run_drill
    from stitch.plugins.cells.job_files import Wanted

    with tell_seconds("drill: the drives of the holes"):
        run_drill(file, servo, Wanted(output, recording, report, session, as_json))


def panel(
    file: JobFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="For the commands.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    drive: Annotated[
        str | None,
        typer.Option(
            "--drive",
            metavar="COMMAND",
            help="Moves the robots and measures anew, until the shape is within tolerance.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Robots and tracker in one model; where to send the robots for the panel's place, pose and shape.

    \b
    Examples:
      stitch panel job.toml --report page.html
      stitch panel job.toml -o moves --drive "./drive-and-measure moves/shape_move.csv"
    """
    from stitch.plugins.cells.job_files import Wanted
    from stitch.plugins.cells.panel import run_panel

    with tell_seconds("panel: robots and tracker in one model"):
        run_panel(file, drive, Wanted(output, recording, report, session, as_json))


def fit(
    file: JobFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="For map and path.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    allowance: Annotated[
        str | None,
        typer.Option(
            metavar="free|varying|SIZE", help="Stock on a casting, outside = plus: found evenly, varying, or stated."
        ),
    ] = None,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow", help="Then answer each table of scans named on standard input with the part's pose, JSON."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fit scans onto a CAD model without a guess: pose, deviation map and corrected robot path.

    \b
    Examples:
      stitch fit fit.toml --report page.html
      stitch fit casting.toml --allowance free
      scan-again | stitch fit body.toml --follow | correct-path
    """
    from stitch.plugins.cells.job_files import Wanted
    from stitch.plugins.cells.window import run_fit

    wanted = Wanted(output, recording, report, session, as_json)
    if follow:
        from stitch.plugins.cells.window import run_follow

        run_follow(file, allowance, wanted)
        return
    with tell_seconds("fit: the scans onto the CAD model"):
        run_fit(file, allowance, wanted)


def seam(
    file: JobFile,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="CSV", help="Write the stations.")] = None,
    recording: RecordingOption = None,
    report: ReportOption = None,
    session: SessionOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure flush and gap at the stations of a seam, with uncertainty and verdict.

    \b
    Examples:
      stitch seam seam.toml --report page.html
    """
    from stitch.plugins.cells.job_files import Wanted
    from stitch.plugins.cells.window import run_seam

    with tell_seconds("seam: flush and gap at every station"):
        run_seam(file, Wanted(output, recording, report, session, as_json))
