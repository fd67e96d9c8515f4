"""`stitch doctor`: which packages are there, what is missing without the others, and the commands that bring them."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stitch.cli.options import Json, require_new
from stitch.cli.terminal import emit, say, show_columns, stdout_for_results
from stitch.errors import InputError
from stitch.system.open3d_library import import_open3d
from stitch.system.packages import DISTRIBUTION, PACKAGES, command_of, small_requirements, stitch_version

# What a bundle holds of a run and of its session: neither clouds nor pictures.
_NUMBERS = ("model.toml", "result.json", "ledger.json", "diagnosis.json", "compare.json")
_TABLES = ("session.toml", "views.csv")


@stdout_for_results
def doctor(
    run: Annotated[
        Path | None, typer.Argument(metavar="RUN", help="A run: with which versions was it computed?")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="ZIP", help="Pack what who helps needs of RUN: numbers, no clouds."),
    ] = None,
    requirements: Annotated[
        Literal["small"] | None,
        typer.Option(help="Print, for pip, what a small install needs: no page, recording, table or simulator."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say which packages are there, what is missing without the others, and what brings them.

    \b
    Examples:
      stitch doctor
      stitch doctor runs/blade-17 --json
      stitch doctor runs/blade-17 -o bundle.zip
      stitch doctor --requirements small
    """
    from stitch.output.json_file import to_json

    if requirements is not None:
        emit(to_json({"requirements": small_requirements()}) if as_json else "\n".join(small_requirements()))
        return
    packages = package_rows()
    document: dict[str, Any] = {"packages": packages}
    open3d = _open3d_lacks()
    if open3d:
        document["open3d"] = open3d
    if run is not None:
        document["run"] = other_versions(run)
    if output is not None:
        _write_bundle(run, output, to_json(document))
    if as_json:
        emit(to_json(document))
        return
    missing = [row for row in packages if row["version"] is None]
    there = f"{len(packages) - len(missing)} of {len(packages)} packages are there"
    say(f"stitch {stitch_version()} ({DISTRIBUTION}): {there}")
    if missing:
        columns = (
            ("missing", lambda row: row["name"]),
            ("not without it", lambda row: row["for"]),
            ("to type", lambda row: row["command"]),
        )
        show_columns("Missing packages", columns, missing, [heading for heading, _ in columns])
    if open3d:
        say(open3d)
    for row in document.get("run", ()):
        say(f"{run}: computed with {row['name']} {row['run']}; here is {row['here'] or 'none'}")


def _write_bundle(run: Path | None, output: Path, report: str) -> None:
    """Pack the numbers of a run and its session's tables, with what is installed here.

    Raises:
        InputError: no run is named, or the file is there.
    """
    from zipfile import ZIP_DEFLATED, ZipFile

    from stitch.output.stored_run import read_result
    from stitch.system.files import whole_file

    if run is None:
        raise InputError(f"{output}: of which run? to fix: stitch doctor RUN -o {output}")
    require_new(output)
    session = Path(read_result(run)["session"])
    with whole_file(output) as scratch, ZipFile(scratch, "w", ZIP_DEFLATED) as bundle:
        bundle.writestr("doctor.json", report)
        for place, names in ((run, _NUMBERS), (session, _TABLES)):
            for file in (place / name for name in names):
                if file.is_file():
                    bundle.write(file, f"{'run' if place == run else 'session'}/{file.name}")
    say(f"{output}: numbers, paths and names of views; read it before you pass it on")


def package_rows() -> list[dict[str, str | None]]:
    """Return name, version (None: not installed), purpose and command of each package."""
    return [
        {"name": name, "version": installed(name), "for": purpose, "command": command_of(name)}
        for name, (_, purpose) in PACKAGES.items()
    ]


def installed(name: str) -> str | None:
    """Return the version of a distribution; None where it is not installed."""
    # One library under two names.
    for known in (name, "open3d-cpu") if name == "open3d" else (name,):
        try:
            return version(known)
        except PackageNotFoundError:
            continue
    return None


def other_versions(run: Path) -> list[dict[str, str | None]]:
    """Return the packages of which a run was computed with another version than the one that is here.

    Raises:
        InputError: no run.
    """
    from stitch.output.stored_run import read_result

    recorded = read_result(run).get("versions") or {}
    if not isinstance(recorded, dict):
        raise InputError(f"{run}/result.json: versions is no table; to fix: run the session again")
    here = {name: installed(DISTRIBUTION if name == "stitch" else name) for name in recorded}
    return [{"name": n, "run": v, "here": here[n]} for n, v in recorded.items() if v != here[n]]


def _open3d_lacks() -> str | None:
    """Return what an Open3D that is installed lacks of the system, in a sentence."""
    try:
        if installed("open3d"):
            import_open3d("Open3D")
    except InputError as lack:
        return str(lack)
    return None
