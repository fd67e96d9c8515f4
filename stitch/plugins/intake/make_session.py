"""From a folder to a session that is written, for `stitch init` and `stitch.init`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from stitch.errors import NoResultError, StitchError
from stitch.plugins.intake.first_session import FirstSession, first_session
from stitch.plugins.intake.folder_files import one_scan_a_file
from stitch.plugins.intake.guesses import Guess
from stitch.plugins.intake.measured_points import measured_session, write_measured
from stitch.plugins.intake.refusals import Fix, Refusal, change
from stitch.plugins.intake.session_draft import draft_files, require_free, write_draft
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.screening.deep_check import deep_check
from stitch.session.reading.session_folder import load_session

Options = Mapping[str, str]
# Where so many of the scanner's motions close, a reading is worth a guess.
_WORTH_A_GUESS = 0.5


@dataclass(frozen=True)
class Made:
    """A session that was written, and what it rests on."""

    views: int
    guesses: tuple[Guess, ...]
    command: str  # that comes next
    inventory: tuple[dict[str, Any], ...] = ()
    not_used: tuple[str, ...] = ()

    @property
    def untold(self) -> list[Guess]:
        """The guesses that neither files nor measurements tell."""
        return [guess for guess in self.guesses if not guess.determined]

    def as_dict(self) -> dict[str, Any]:
        """As `stitch init --json` prints it."""
        return {
            "guesses": [guess.as_dict() for guess in self.guesses],
            "inventory": list(self.inventory),
            "not_used": list(self.not_used),
            "question": self.untold[0].question() if self.untold else None,
        }


@dataclass(frozen=True)
class Company:
    """Who is told and asked meanwhile; nobody, if nothing is said."""

    activity: Callable[[str], AbstractContextManager[Any]] = lambda _: nullcontext()
    tell: Callable[[Sequence[Guess]], None] = lambda _: None
    ask: Callable[[FirstSession], Options] | None = None  # what a person states instead of guesses; {}: it is right


def make_session(
    folder: Path, out: Path, options: Options, *, guess: bool, force: bool, company: Company = Company()
) -> Made:
    """Write session.toml, views.csv and, of targets, points.csv or frames.csv.

    Args:
        options: of `stitch init`, by name, as texts.
        guess: what neither files nor scans tell is guessed; else it is asked, or refused.

    Raises:
        InputError: what cannot be read or told; a `Refusal` carries what leads on.
    """
    stated = StatedFolder.of(options)
    with company.activity(f"{folder.name}: reading the tables and trying conventions"):
        measured = measured_session(folder, stated)
    if measured is not None:
        company.tell(measured.guesses)
        made = Made(len(measured.way.pairing.used), measured.guesses, "run")
        if not guess:
            _require_determined(out, made)
        write_measured(out, measured, force=force)
        return made
    if not force:
        require_free(out, draft_files(not stated.targets.is_empty))
    with one_scan_a_file(folder) as scans, _named_as(scans, folder):
        first = _judge(scans, stated, company)
        if guess and stated.rotation is None:
            _require_fit(scans, first, company)
        while not guess and company.ask is not None and (answers := company.ask(first)):
            first = _judge(scans, StatedFolder.of({**options, **answers}), company)
        inventory = tuple(found.as_dict() for found in first.files.inventory)
        command = "run" if first.sphere_mm is None else "calibrate sphere"
        made = Made(len(first.pairing.used), first.guesses, command, inventory, first.not_used)
        if not guess and company.ask is None:
            _require_determined(out, made)
        write_draft(out, first, force=force, unpacked=scans != folder)
    return made


def _judge(folder: Path, stated: StatedFolder, company: Company) -> FirstSession:
    """Return the session that files and scans tell of, after its guesses are told."""
    with company.activity(f"{folder.name}: reading the scans and trying conventions"):
        first = first_session(folder, stated)
    company.tell(first.guesses)
    return first


@contextmanager
def _named_as(scratch: Path, folder: Path) -> Iterator[None]:
    """Name a folder in refusals in place of a passing one, which is gone when they are read."""
    try:
        yield
    except Refusal as refused:
        if scratch == folder:
            raise
        raise refused.named(scratch, folder) from None
    except StitchError as error:
        error.what = error.what.replace(str(scratch), str(folder))
        raise


def _require_fit(folder: Path, first: FirstSession, company: Company) -> None:
    """Refuse poses that contradict the scans under every reading, with the mistake that explains it.

    Raises:
        InputError: what the deep check finds wrong for certain.
    """
    choice = first.choice
    if choice.determined or first.sphere_mm is not None or (choice.best.closed or 0.0) >= _WORTH_A_GUESS:
        return
    trying = company.activity("no reading fits clearly: trying the usual mistakes")
    with TemporaryDirectory() as draft, _named_as(Path(draft), folder), trying:
        write_draft(Path(draft), first)
        session = load_session(Path(draft))
        try:
            certain = [p for p in deep_check(session) if p.certain]
            # What is wrong with all views comes before what is wrong with one.
            found = [
                p.line(session.names) for p in sorted(certain, key=lambda p: 0 < len(p.views) < len(session.views))
            ]
        except NoResultError as error:
            found = [str(error).replace(draft, str(folder))]
    if found:
        what, _, advice = found[0].partition("; to fix: ")
        states = {"rotation": choice.best.interpretation.reading.rotation}
        known = Fix(f"write it all the same with --rotation {states['rotation']}", states)
        told = f"{folder}: no session was written, as no reading of the poses fits the scans. {what}"
        raise Refusal(told, *([change(folder, advice)] if advice else []), known)


def _require_determined(out: Path, made: Made) -> None:
    """Refuse guesses that neither files nor measurements tell."""
    if untold := made.untold:
        flags = ", ".join(dict.fromkeys(guess.flag for guess in untold))
        told = f"{out}: {', '.join(guess.what for guess in untold)} cannot be told from these views"
        states = {name: value for guess in untold for name, value in guess.states.items()}
        ways = Fix(f"state {flags}", states), Fix("guess with --yes", {"yes": "yes"})
        raise Refusal(told, *ways, found=made.as_dict())
