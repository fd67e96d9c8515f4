"""What this package is called where packages are installed, and the line that says how one that is missing comes.

`import stitch` and the command `stitch` belong to the distribution DISTRIBUTION: on PyPI, `stitch` is somebody else's.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

from stitch.errors import InputError

DISTRIBUTION = "stitch-scans"


def stitch_version() -> str:
    """Return the version that is installed."""
    from importlib.metadata import version  # a third of `import stitch`, which needs none

    return version(DISTRIBUTION)


def command_for(extra: str) -> str:
    """Return the command that installs what an extra of this package brings."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def import_extra(name: str, where: Path | str, extra: str) -> Any:
    """Return a package by its name of import; only some files need it, and an extra of this package installs it.

    Args:
        where: the file, the flag or what else needs it.
        extra: of this package.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"{where}: needs the package {name}; to fix: {command_for(extra)}") from None
