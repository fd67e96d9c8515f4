"""What was guessed about a folder: each guess with its reason, what decides it, and the flag that overrules it."""

from dataclasses import dataclass
from typing import Any, Literal

Because = Literal["file", "scans", "usual"]


@dataclass(frozen=True)
class Guess:
    """One thing that the files do not say, or say only in a name."""

    what: str  # "rotation", "mount" …
    value: str
    reason: str
    determined: bool  # the files or the scans tell it; False: it cannot be told from these views
    flag: str  # that overrules it
    runner_up: str | None = None
    by: Because = "file"  # what decides it; a guess that is not determined is only usual
    worse_by: float | None = None  # how many times worse the runner-up fits the scans

    @property
    def because(self) -> Because:
        """What decides it: a file or a person says so, the scans say so, or it is only usual."""
        return self.by if self.determined else "usual"

    @property
    def line(self) -> str:
        """For a comment or a terminal; what is only usual with a question mark."""
        return f"{'? ' if self.because == 'usual' else ''}{self._words}"

    @property
    def _words(self) -> str:
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
            "because": self.because,
            "against": [{"what": self.runner_up, "worse_by": self.worse_by}] if self.runner_up else [],
        }
