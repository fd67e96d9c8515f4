"""What was guessed about a folder: each guess with its reason, how sure it is, and the flag that overrules it."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Guess:
    """One thing that the files do not say, or say only in a name."""

    what: str  # "rotation", "mount" …
    value: str
    reason: str
    determined: bool  # the files or the scans tell it; False: it cannot be told from these views
    flag: str  # that overrules it
    runner_up: str | None = None

    @property
    def line(self) -> str:
        """For a comment or a terminal."""
        untold = "" if self.determined else f" cannot be told from these views, {self.flag} overrules it;"
        other = f"; next best: {self.runner_up}" if self.runner_up else ""
        return f"{self.what}: {self.value};{untold} {self.reason}{other}"

    def as_dict(self) -> dict[str, Any]:
        """As `stitch init --json` prints it."""
        return {
            "what": self.what,
            "value": self.value,
            "reason": self.reason,
            "told": self.determined,
            "flag": self.flag,
            "runner_up": self.runner_up,
        }
