"""Packages of the extras, which not every installation has."""

import pytest


def needs(name, extra):
    """The package, or a skip that says with which command the test runs."""
    reason = (
        f"{name} is not installed, and without it nothing reads or writes such files: pip install 'stitch[{extra}]'"
    )
    return pytest.importorskip(name, reason=reason)
