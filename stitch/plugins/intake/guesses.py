"""What was guessed about a folder: each guess with its reason, what decides it, and the flag that overrules it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Because = Literal["file", "scans", "usual"]
# Guesses that are asked for one by one.
_QUESTIONS = ("rotation", "length_unit", "cloud_unit", "mount")


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
    states: Mapping[str, str] = field(default_factory=dict)  # options of `stitch init` that state the same
    other: Mapping[str, str] = field(default_factory=dict)  # and those that state the runner-up

    @property
    def because(self) -> Because:
        """What decides it: a file or a person says so, the scans say so, or it is only usual."""
        return self.by if self.determined else "usual"

    @property
    def is_asked(self) -> bool:
        """Whether a person on a terminal is asked."""
        return not self.determined and self.what in _QUESTIONS

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
            "question": self.question(),
        }

    def question(self) -> dict[str, Any]:
        """What a person would be asked, as `stitch init --json` prints it."""
        answers = [self.value, *filter(None, [self.runner_up])]
        fixes = [dict(options) for options in (self.states, self.other) if options]
        return {"what": self.what, "flag": self.flag, "answers": answers, "options": fixes}
