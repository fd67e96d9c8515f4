"""`stitch.init`: what `stitch init` does, from Python."""

from collections.abc import Sequence
from pathlib import Path

from stitch.api.session import Session, load_session
from stitch.plugins.intake.make_session import make_session


def init(
    folder: Path | str,
    output: Path | str | None = None,
    *,
    poses: Path | str | None = None,
    columns: str | Sequence[str] | None = None,
    rows: str | None = None,
    rotation: str | None = None,
    angles: str | None = None,
    unit: str | None = None,
    cloud_unit: str | None = None,
    orientation: str | Sequence[float] | None = None,
    mount: str | None = None,
    inverse: bool | None = None,
    within: str | Sequence[float] | None = None,
    board: str | None = None,
    ball: str | float | None = None,
    guess: bool = False,
    force: bool = False,
) -> Session:
    """Write a session of a folder of scans and poses, and return it as it lies there.

    Args:
        output: folder of the session; None: beside the scans.
        poses … ball: state what `stitch init` takes as options of these names; None: files and scans tell it.
        guess: what neither of them tells is guessed.
        force: replace a session that lies there.

    Returns:
        The session, checked; lengths in its length_unit.

    Raises:
        InputError: what cannot be read or told; its `fixes` say as data what leads on, as words, as a command line and
            as a call of this function.

    Example:
        >>> try:
        ...     stitch.init(folder / "nowhere")
        ... except stitch.InputError as error:
        ...     print(error.fix_python)
        name the folder of the scans
    """
    given = {
        "poses": poses, "columns": columns, "rows": rows, "rotation": rotation, "angles": angles, "unit": unit,
        "cloud_unit": cloud_unit, "orientation": orientation, "mount": mount, "within": within, "board": board,
        "ball": ball,
    }  # fmt: skip
    options = {name: _text(value) for name, value in given.items() if value is not None}
    if inverse is not None:
        options["inverse"] = "yes" if inverse else "no"
    out = Path(output or folder)
    make_session(Path(folder), out, options, guess=guess, force=force)
    return load_session(out)


def _text(value: object) -> str:
    """An option as it is typed."""
    return ",".join(map(str, value)) if isinstance(value, Sequence) and not isinstance(value, str) else str(value)
