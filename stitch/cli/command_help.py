"""What a command is for, read from its source: a list of all commands does not wait for the libraries of all."""

import ast
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path


def command_help(entry: EntryPoint) -> str | None:
    """The docstring of the function behind an entry, or the `help` of a group of commands; None where it is neither."""
    try:
        nodes = ast.parse(_module_source(entry.module)).body
    except (OSError, SyntaxError, ValueError):
        return None
    for node in nodes:
        match node:
            case ast.FunctionDef(name=name) if name == entry.attr:
                return ast.get_docstring(node)
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Call(keywords=keywords)) if name == entry.attr:
                given = next((key.value for key in keywords if key.arg == "help"), None)
                return given.value if isinstance(given, ast.Constant) and isinstance(given.value, str) else None
    return None


def _module_source(module: str) -> str:
    """Source of a module; the packages above it are not imported."""
    top, *inner = module.split(".")
    spec = find_spec(top)
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        file = Path(folder, *inner).with_suffix(".py")
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return ""
