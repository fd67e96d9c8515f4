"""State of one `stitch review`: the run folder, the trusted files, the commands it may run."""

import re
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError
from stitch.model.model_toml import read_model
from stitch.numerics.frames import Indices
from stitch.numerics.units import MICROMETRES
from stitch.output.run_folder import restore_fit
from stitch.system.files import whole_file
from viz.review.chosen_field import Choice, PatchWeights, chosen_numbers, numbered_marks, patch_weights
from viz.review.residual_rows import ResidualRows, read_rows
from viz.review.run_snapshot import Snapshot, read_snapshot, version_of

# The residuals of a model as a review keeps them, and what is asked of them.


@dataclass(frozen=True)
class KnownResiduals:
    """Residuals of a model, what a picture of the part shows of them, and the numbers of all of them."""

    model: str
    rows: ResidualRows
    shown: PatchWeights | Indices  # marks (M, 2) of labelled points
    all: dict[str, Any]

    def chosen(self, choice: Choice, comparison: dict[str, Any] | None, um: float) -> dict[str, Any]:
        """Field and numbers of a choice.

        Raises:
            InputError: a view, a property or a bin that the run does not have.
        """
        if isinstance(self.shown, PatchWeights) and choice.place is not None and not choice.within:
            choice = replace(choice, within=2 * self.shown.radius)
        return chosen_numbers(self.rows, self.shown, choice, comparison, um)


def known_residuals(run: Path, found: Snapshot, um: float) -> KnownResiduals:
    """Read what a run left.

    Args:
        um: micrometres in one length_unit.

    Raises:
        InputError: a damaged file, or a page without the part.
    """
    labelled = found.state["labelled"]
    rows = read_rows(run, found.result, labelled)
    shown: PatchWeights | Indices = np.zeros((0, 2), np.int64)
    if found.part is not None:
        shown = (numbered_marks if labelled else patch_weights)(rows, found.part)
    elif not labelled:
        raise InputError(f"{run}: has no surfaces to show a part of")
    return KnownResiduals(found.model, rows, shown, chosen_numbers(rows, shown, Choice(), None, um))


# A person's own file in the run folder, which no command takes away.
OWN_EFFECTS = "review_effects.py"
_NAME = re.compile(r"[A-Za-z_]\w{0,80}")
_LONGEST_NOTE, _LONGEST_NAME = 2000, 80


@dataclass
class RunReview:
    """A run folder under review; what is asked from several threads is computed once."""

    run: Path
    effects_file: Path | None = None  # of the user's own, trusted by naming it
    trust: bool = False  # the file that the model names
    _allowed: str | None = None  # that file: a model without its effects names it no more, but may have them back
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _last: Snapshot | None = None
    _rows: KnownResiduals | None = None
    # One thread computes: what it gives back is its own again, where each of many would keep a share.
    _computing: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1))

    @property
    def version(self) -> str:
        """Changes with any file of the run that is shown."""
        return version_of(self.run)

    @property
    def model(self) -> str:
        """Changes with the model of the run."""
        return version_of(self.run, ("result.json",))

    def snapshot(self) -> Snapshot:
        """The run as it stands.

        Raises:
            InputError: no run folder any more, or a damaged file in it.
        """
        with self._lock:
            if self._last is None or self._last.version != self.version:
                self._last = read_snapshot(self.run)
            return self._last

    def state(self) -> dict[str, Any]:
        """The snapshot's, with what was trusted; a folder that cannot be read says why."""
        try:
            state = self.snapshot().state
        except InputError as error:
            return {"problem": str(error), "version": self.version, "run": str(self.run)}
        return state | {"problem": None, "trust": self._asked_for_trust(), "own": self.own_effects()}

    def own_effects(self) -> str:
        """Text of the file of own effects in the run folder; empty where there is none."""
        try:
            return (self.run / OWN_EFFECTS).read_text(encoding="utf-8")
        except (OSError, ValueError):
            return ""

    def keep_own_effects(self, text: str) -> Path:
        """Write the text as the run folder's own effects."""
        path = self.run / OWN_EFFECTS
        with whole_file(path) as file:
            file.write_text(text, encoding="utf-8")
        return path

    def use_own_effects(self) -> None:
        """Every further command knows them; a file that no command could read would end them all."""
        self.effects_file = self.run / OWN_EFFECTS

    def warm(self) -> None:
        """Read the residuals before somebody chooses among them."""
        with suppress(InputError):
            self.chosen(Choice())

    def chosen(self, choice: Choice) -> dict[str, Any]:
        """Field and numbers of a choice.

        Raises:
            InputError: the run has no such view, property or bin, or no field.
        """
        return self._computing.submit(self._chosen, choice).result()

    def _chosen(self, choice: Choice) -> dict[str, Any]:
        found = self.snapshot()
        um = MICROMETRES[found.result["length_unit"]]
        if self._rows is None or self._rows.model != found.model:
            self._rows = None  # two at once would take twice the memory
            self._rows = known_residuals(self.run, found, um)
        known = self._rows
        return {"model": found.model, "all": known.all, "chosen": known.chosen(choice, found.comparison, um)}

    def restore(self, kind: str, asked: dict[str, Any]) -> bool:
        """Bring back the fit that a change of the model leads to, where the run folder keeps it; False elsewhere.

        Raises:
            InputError: as `arguments`, or another process writes there.
        """
        found = self.snapshot()
        change = found.state["history"][kind] if kind in ("undo", "redo") else {"command": kind} | asked
        if change is None:
            return False
        present, named = set(found.result["effects"]), set(_names(change.get("effects")))
        target = present | named if change["command"] == "add" else present - named
        return target != present and restore_fit(self.run, target, bool(found.state["recording"]))

    def arguments(self, kind: str, asked: dict[str, Any]) -> list[str]:
        """The command of what a page asked for.

        Raises:
            InputError: something that no command is made of.
        """
        run = str(self.run)
        match kind:
            case "compare" | "diagnose" | "next":
                return [kind, run, *self._trusted()]
            case "report":
                return [kind, run, "--no-diagnosis", *self._trusted()]
            case "add" | "drop":
                quiet = [] if (self.run / "recording.rrd").is_file() else ["--no-recording"]
                return [kind, run, *_names(asked.get("effects")), *quiet, *self._trusted()]
            case "group":
                return ["add", run, "--group", *self._trusted()]
            case "explain":
                return [kind, run, *self._trusted()]
            case "export":
                return [kind, run, "--to", "ros", *self._trusted()]
            case "undo" | "redo":
                change = self.snapshot().state["history"][kind]
                if change is None:
                    raise InputError(f"there is nothing to {kind}")
                return self.arguments(change["command"], change)
            case "note":
                by = _text(asked.get("by", ""), _LONGEST_NAME)
                return ["note", run, *(["--by", by] if by else []), "--", _text(asked.get("text"), _LONGEST_NOTE)]
            case "own":
                words = ["diagnose", run] if asked.get("diagnose") is True else ["effects"]
                return [*words, "--effects-file", str(self.run / OWN_EFFECTS)]
        raise InputError("no such command here")

    def _trusted(self) -> list[str]:
        if self.effects_file is not None:
            return ["--effects-file", str(self.effects_file)]
        if not self.trust:
            return []
        named = read_model(self.run).effects_file
        if named is None:
            return [] if self._allowed is None else ["--effects-file", self._allowed]
        self._allowed = named
        return ["--trust"]

    def _asked_for_trust(self) -> dict[str, str] | None:
        """The file of effects that the model names, where nobody has allowed it yet."""
        if self.effects_file is not None or self.trust:
            return None
        named = read_model(self.run).effects_file
        if named is None:
            return None
        try:
            text = Path(named).read_text(encoding="utf-8")
        except (OSError, ValueError):
            text = "(cannot be read)"
        return {"file": named, "text": text}


def _names(effects: object) -> list[str]:
    """Names of effects, which no option of a command can be."""
    named = isinstance(effects, list) and effects and all(isinstance(e, str) and _NAME.fullmatch(e) for e in effects)
    if not named or not isinstance(effects, list):
        raise InputError("effects: to fix: a list of their names")
    return effects


def _text(text: object, longest: int) -> str:
    if not isinstance(text, str) or len(text) > longest or "\0" in text:
        raise InputError(f"to fix: a text of at most {longest} characters")
    return text.strip()
