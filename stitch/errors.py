"""The two ways a command can end without a result; the CLI turns them into exit codes."""


class StitchError(Exception):
    """Base of every error that is shown to the user as one line, without a traceback."""

    exit_code = 1


class InputError(StitchError):
    """Bad input or usage: the message names the file, line or view, and how to fix it (exit code 2)."""

    exit_code = 2


class BusyError(InputError):
    """Another process writes there: the same may do in a while."""


class NoResultError(StitchError):
    """Good input, but the computation reached no result: says why and what to try (exit code 1)."""

    exit_code = 1
