"""The run folder on disk: written whole or not at all."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.metadata import entry_points
from pathlib import Path
from threading import Thread
from typing import Any

from stitch.errors import InputError
from stitch.model.model_toml import write_model
from stitch.runs.run import Run
from stitch.system.whole_folder import claim_folder, rewrite_folder
from stitch.writing.json_file import write_json
from stitch.writing.result_document import ledger, model_of, result_document
from stitch.writing.run_contents import is_run_file, require_free
from stitch.writing.tables import write_cloud, write_residuals


@contextmanager
def new_folder(path: Path, sessions: Sequence[Path], force: bool = False) -> Iterator[Path]:
    """A scratch folder that takes the place of `path` if the block succeeds, and goes if it fails.

    Of what stands there, only what a run wrote goes; a person's own files stay.

    Args:
        sessions: folders of the sessions that are run.
        force: replace the run of other sessions too.

    Raises:
        InputError: `path` is no place for this run, or another process writes there.
    """
    require_free(path, sessions, force)
    with rewrite_folder(path, is_run_file(path)) as scratch:
        yield scratch


@contextmanager
def replace_run_files(path: Path) -> Iterator[Path]:
    """A scratch folder whose files take the place of all that was made of the old model if the block succeeds."""
    with rewrite_folder(path, is_run_file(path)) as scratch:
        yield scratch


@contextmanager
def lock_run_folder(path: Path) -> Iterator[None]:
    """Hold a run folder as its only writer, from reading it to writing into it.

    Raises:
        InputError: another process writes there, or its folder of pictures is a link to elsewhere.
    """
    if not path.parent.is_dir():
        yield
        return
    with claim_folder(path):
        if (path / "pictures").is_symlink():
            raise InputError(f"{path}/pictures: is a link, and pictures would be written where it points; remove it")
        yield


def call_entry_points(group: str, *arguments: Any) -> None:
    """Call what other packages offer under an entry-point group."""
    for entry in entry_points(group=group):
        entry.load()(*arguments)


def preload_entry_points(group: str) -> None:
    """Load beside the fit what `extend` calls after it: it leaves a core idle, and drawing takes a second to load."""

    def load() -> None:
        # What fails here fails again where it is called, and is said there.
        with suppress(Exception):
            for entry in entry_points(group=group):
                entry.load()

    Thread(target=load, daemon=True).start()


def write_run(run: Run, folder: Path) -> None:
    """Write model.toml, result.json, ledger.json, stitched.ply and residuals.parquet into `folder`."""
    _write_documents(run, folder)
    _write_points(run, folder)


def write_with_page(run: Run, folder: Path, tolerance: float | None = None) -> None:
    """The same and report.html, drawn while the points are written.

    Args:
        tolerance: within which the views have to agree on the part, length_unit.
    """
    _write_documents(run, folder)
    with ThreadPoolExecutor(1) as beside:
        written = beside.submit(_write_points, run, folder)
        call_entry_points("stitch.reports", run, folder / "report.html", tolerance)
        written.result()


def _write_documents(run: Run, folder: Path) -> None:
    write_model(model_of(run), folder / "model.toml")
    write_json(result_document(run), folder / "result.json")
    write_json(ledger(run), folder / "ledger.json")


def _write_points(run: Run, folder: Path) -> None:
    write_cloud(run.fused, folder / "stitched.ply")
    write_residuals(run, folder / "residuals.parquet")
