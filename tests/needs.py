"""Packages of the extras, which not every installation has."""

import pytest

from stitch.system.packages import command_for


def needs(name, extra):
    """The package, or a skip that says with which command the test runs."""
    reason = f"{name} is not installed, and without it nothing reads or writes such files: {command_for(extra)}"
    return pytest.importorskip(name, reason=reason)


def needs_open3d():
    """Open3D as a user imports it, or a skip that says what it lacks here."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        pytest.skip(f"Open3D cannot be imported ({error}): its geometries are tried where it can")
    return open3d
