"""The two ways a command can end without a result; the CLI turns them into exit codes.

What to do about it may read differently on the command line and in a program: an error carries both.
"""

from collections.abc import Iterable

_TO_FIX = "; to fix: "


class StitchError(Exception):
    """Base of every error that is shown to the user as one line, without a traceback.

    `str(error)` says what is wrong and `fix_python`; `error.command_line` says what is wrong and `fix_cli`.

    Args:
        message: what is wrong, and where; "; to fix: …" in it serves both callers.
        fix_cli, fix_python: what to type, and what to write in a program, where that is not the same.

    Example:
        >>> issubclass(stitch.InputError, stitch.StitchError), issubclass(stitch.NoResultError, stitch.StitchError)
        (True, True)
        >>> error = stitch.InputError("run: there already", fix_cli="state --force", fix_python="pass force=True")
        >>> print(error)
        run: there already; to fix: pass force=True
        >>> print(error.command_line)
        run: there already; to fix: state --force
    """

    exit_code = 1

    def __init__(self, message: str = "", *, fix_cli: str = "", fix_python: str = "") -> None:
        super().__init__(message)
        what, _, fix = message.partition(_TO_FIX)
        self.what: str = what
        self.fix_cli: str = fix_cli or fix or fix_python
        self.fix_python: str = fix_python or fix or fix_cli

    @property
    def command_line(self) -> str:
        """The line as a command prints it."""
        return f"{self.what}{_TO_FIX}{self.fix_cli}" if self.fix_cli else self.what

    def __str__(self) -> str:
        return f"{self.what}{_TO_FIX}{self.fix_python}" if self.fix_python else self.what


class InputError(StitchError):
    """Bad input or usage: the message names the file, line or view, and how to fix it (exit code 2).

    Example:
        >>> try:
        ...     stitch.load_session("nowhere")
        ... except stitch.InputError as error:
        ...     print(error)
        nowhere/session.toml: ...
    """

    exit_code = 2


class ScaleError(InputError):
    """Lengths that only make sense in another unit.

    Args:
        message: what is wrong, where, and how to fix it.
        views: names of the views whose lengths are meant; () means all views.
    """

    def __init__(self, message: str, views: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.views = views


class NothingMeasuredError(InputError):
    """A scan that shows nothing: no points, or none that count."""


class BusyError(InputError):
    """Another process writes there: the same may do in a while."""


class NoResultError(StitchError):
    """Good input, but the computation reached no result: says why and what to try (exit code 1).

    Example:
        >>> two = stitch.Session.from_arrays(clouds[:2], poses[:2], mount="eye_in_hand")
        >>> try:
        ...     stitch.run(two)
        ... except stitch.NoResultError as error:
        ...     print(error)
        a hand-eye cannot be found from fewer than 3 views: ...
    """

    exit_code = 1


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'range_scale'?" for the known name that is closest to a misspelt one; "" if none is."""
    from difflib import get_close_matches

    by_small_letters = {other.lower(): other for other in known}
    close = get_close_matches(str(name).lower().replace("-", "_"), by_small_letters, n=1)
    return f"; did you mean {by_small_letters[close[0]]!r}?" if close else ""
