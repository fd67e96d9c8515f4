"""`stitch review FOLDER`: serve the review of a run, or the way from scans to one, to a browser on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import EffectsFile, Trust


def review(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A run, or a session, or scans with their poses.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="RUN", help="Run folder of scans; default runs/NAME.")
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port to listen on; default a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open a browser.")] = True,
    effects_file: EffectsFile = None,
    trust: Trust = False,
) -> None:
    """See in a browser where a run fails, add what is missing, and watch the error fall; ends with Ctrl-C.

    Of scans, the page first asks what their files do not say, runs them and diagnoses the run.

    \b
    Examples:
      stitch review runs/blade-17
      stitch review scans -o runs/blade-17
      stitch review runs/blade-17 --port 8080 --no-browser
    """
    # Imported here so that --help stays fast.
    from viz.review.web_app import serve_review

    serve_review(folder, output, port, browser=browser, effects_file=effects_file, trust=trust)
