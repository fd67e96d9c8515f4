"""Where the program of the rerun library lies."""

import shutil
import sys
from pathlib import Path


def rerun_program() -> str:
    """The program that came with the library."""
    return shutil.which("rerun", path=str(Path(sys.executable).parent)) or "rerun"
