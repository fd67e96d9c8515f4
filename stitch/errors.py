"""The two ways a command can end without a result; the CLI turns them into exit codes."""


class StitchError(Exception):
    """Base of every error that is shown to the user as one line, without a traceback.

    Example:
        >>> issubclass(stitch.InputError, stitch.StitchError), issubclass(stitch.NoResultError, stitch.StitchError)
        (True, True)
    """

    exit_code = 1


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
