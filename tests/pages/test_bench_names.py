"""Benches run seldom: what they import from the project still has to be there."""

import ast
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OWN = {"stitch", "data_synth", "viz"}


@pytest.mark.parametrize("folder", ["bench", "examples"])
def test_what_benches_import_is_there(folder):
    lacking = []
    for file in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OWN:
                lacking += [
                    f"{file.name}: {node.module}.{a.name}" for a in node.names if not found(node.module, a.name)
                ]
    assert not lacking


def found(module, name):
    """Whether a module has a name, or a module below it."""
    try:
        return hasattr(importlib.import_module(module), name) or bool(importlib.import_module(f"{module}.{name}"))
    except ModuleNotFoundError:
        return False
