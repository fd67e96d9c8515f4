"""A page on paper: printed to PDF by a Chromium that is on the path."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from stitch.errors import InputError, NoResultError
from stitch.system.whole_file import whole_file

_BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
    "msedge",
)
_SECONDS = 120


def printing_browser() -> str:
    """Path of a browser that prints.

    Raises:
        InputError: none is on the path.
    """
    found = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        raise InputError(
            "--pdf: no Chromium, Chrome or Edge is on the path; to fix: install one, or print report.html by hand"
        )
    return found


def print_page(browser: str, page: Path, path: Path) -> None:
    """Print `page` to `path`, whole or not at all.

    Raises:
        NoResultError: the browser did not print.
    """
    # As root a browser has no sandbox, and without a display no graphics card.
    root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    with whole_file(path) as file, tempfile.TemporaryDirectory() as profile:
        arguments = ["--headless", "--disable-gpu", *root, f"--user-data-dir={profile}", "--no-pdf-header-footer"]
        target = Path(profile) / "page.pdf"
        try:
            subprocess.run(
                [browser, *arguments, f"--print-to-pdf={target}", page.resolve().as_uri()],
                capture_output=True,
                timeout=_SECONDS,
                check=True,
            )
            shutil.copyfile(target, file)
        except (subprocess.SubprocessError, OSError):
            raise NoResultError(f"{browser} could not print {page}; print it by hand") from None
