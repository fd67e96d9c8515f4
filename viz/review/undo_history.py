"""Undo and redo, read from the ledger alone: it only grows, and a return to an earlier model is one of its steps."""

from collections.abc import Sequence
from typing import Any

Effects = Sequence[str]


def undo_history(steps: Sequence[Effects]) -> dict[str, Any]:
    """What undo and redo would do: {"undo": {"command", "effects", "to"}, "redo": …}, None where there is nothing.

    Args:
        steps: effects of the model at every step of the ledger, the present one last.
    """
    visited, at = _visited(steps)
    return {
        "undo": _change(visited[at], visited[at - 1]) if at > 0 else None,
        "redo": _change(visited[at], visited[at + 1]) if at + 1 < len(visited) else None,
    }


def _visited(steps: Sequence[Effects]) -> tuple[list[Effects], int]:
    """Models as a browser keeps pages, and which of them is shown: a step to a neighbour goes there."""
    visited: list[Effects] = [steps[0]] if steps else [()]
    at = 0
    for effects in steps[1:]:
        if set(effects) == set(visited[at]):
            continue
        if at > 0 and set(effects) == set(visited[at - 1]):
            at -= 1
        elif at + 1 < len(visited) and set(effects) == set(visited[at + 1]):
            at += 1
        else:
            visited = [*visited[: at + 1], effects]
            at += 1
    return visited, at


def _change(present: Effects, target: Effects) -> dict[str, Any] | None:
    """The one command that leads there; None where it takes two."""
    new = [effect for effect in target if effect not in present]
    gone = [effect for effect in present if effect not in target]
    if bool(new) == bool(gone):
        return None
    return {"command": "add" if new else "drop", "effects": new or gone, "to": list(target)}
