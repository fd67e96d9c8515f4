"""Programs of a cell that a command calls: they move the machines, and answer on their standard output.

Each call is one process. A JSON object goes to its standard input; it ends with exit code 0 where it did what was
asked, 3 where the robot cannot reach the pose.
"""

import json
import shlex
import subprocess
from typing import Any

from stitch.errors import InputError, NoResultError

CANNOT_REACH = 3


class UnreachableError(NoResultError):
    """The program says that the robot cannot reach the pose."""


def call_program(
    option: str, command: str, question: dict[str, Any] | None = None, seconds: float | None = None
) -> str:
    """Run a program and return what it printed on standard output.

    Args:
        option: of our command line that named the program, such as "--drive", for messages.
        command: program and arguments as in a shell.
        question: goes to its standard input as one JSON object; None: the program inherits our standard input.
        seconds: after which it is killed; None: it may take any time.

    Raises:
        InputError: it cannot be started.
        UnreachableError: it ended with exit code 3.
        NoResultError: it failed or took too long.
    """
    try:
        done = subprocess.run(
            shlex.split(command),
            check=False,
            capture_output=True,
            text=True,
            input=None if question is None else json.dumps(question) + "\n",
            timeout=seconds,
        )
    except subprocess.TimeoutExpired:
        raise NoResultError(
            f"{option} {command}: no answer after {seconds:g} s. The robots stand where it left them; to fix: see what "
            "it waits for, or allow more seconds"
        ) from None
    except (OSError, ValueError) as error:
        raise InputError(f"{option} {command}: {error}; to fix: write a program and its arguments") from None
    message = (done.stderr.strip().splitlines() or ["no message"])[-1]
    if done.returncode == CANNOT_REACH:
        raise UnreachableError(f"{option} {command}: the robot cannot reach the pose ({message})")
    if done.returncode:
        raise NoResultError(
            f"{option} {command}: exit code {done.returncode}, {message}. The robots stand where it left them; to fix: "
            "see its message, then call again"
        )
    return done.stdout
