"""One mistake of a session: its kind, the views it concerns and what to do."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from stitch.integrity.view_names import list_views


@dataclass(frozen=True)
class SessionProblem:
    """What is wrong, where, and how to put it right; `views` is empty where it concerns the whole session."""

    # exchanged | shifted | reversed | inverse | mount | euler | degrees | quaternion | unit | scale | mirrored |
    # joint_row | duplicate_scan | duplicate_pose | displaced | foreign | reclamped | disconnected
    kind: str
    views: tuple[str, ...]
    fix: str  # one line
    certain: bool = True  # False: a hint that the numbers do not prove

    def as_dict(self) -> dict[str, Any]:
        """As `stitch check --deep --json` prints it."""
        return {"kind": self.kind, "views": list(self.views), "fix": self.fix}

    def line(self, order: Sequence[str]) -> str:
        """As a message: kind, views, to fix; with the names of all views as they follow each other."""
        where = f" ({list_views(self.views, order)})" if self.views else ""
        return f"{self.kind}{where}: {self.fix}"
