"""The run folder on disk: written whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from stitch.errors import InputError
from stitch.model.model_toml import write_model
from stitch.runs.run import Run
from stitch.writing.json_file import write_json
from stitch.writing.result_document import ledger, model_of, result_document
from stitch.writing.tables import write_cloud, write_residuals

_SCRATCH = ".new"
# What commands make of a model and no change of it makes anew, or not always.
_OF_THE_MODEL = (
    "diagnosis.json", "diagnosis.rrd", "compare.json", "mesh.ply", "recording.rrd", "robot.toml", "robot.urdf",
)  # fmt: skip


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A scratch folder that takes the place of `path` if the block succeeds, and goes if it fails.

    Raises:
        InputError: `path` holds something that is not a run, or holds the present folder.
    """
    here = Path.cwd()
    if path.resolve() in (here, *here.parents):
        raise InputError(f"{path}: one stands in this folder, and a run replaces it; name another with -o")
    if path.exists() and not _is_run(path):
        raise InputError(f"{path}: exists and is not a run folder; name another with -o")
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        yield scratch
        _replace(scratch, path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _is_run(path: Path) -> bool:
    return path.is_dir() and ((path / "model.toml").is_file() or not any(path.iterdir()))


def _replace(scratch: Path, path: Path) -> None:
    # A folder cannot replace a full one in one step: the old run steps aside until the new one stands.
    scratch.chmod(0o777 & ~_umask())
    old = path.with_name(f".{path.name}.old-{os.getpid()}")
    if path.exists():
        path.rename(old)
    scratch.rename(path)
    shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@contextmanager
def changed(path: Path) -> Iterator[Path]:
    """A scratch folder whose files take their place in a run folder if the block succeeds; it goes if it fails.

    What else was made of the old model goes then too.
    """
    scratch = path / _SCRATCH
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        yield scratch
        for stale in _OF_THE_MODEL:
            (path / stale).unlink(missing_ok=True)
        shutil.rmtree(path / "pictures", ignore_errors=True)
        for file in sorted(scratch.iterdir()):
            file.replace(path / file.name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def extend(group: str, *arguments: Any) -> None:
    """Call what other packages offer under an entry-point group."""
    for entry in entry_points(group=group):
        entry.load()(*arguments)


def write_run(run: Run, folder: Path) -> None:
    """Write model.toml, result.json, ledger.json, stitched.ply and residuals.parquet into `folder`."""
    write_model(model_of(run), folder / "model.toml")
    write_json(result_document(run), folder / "result.json")
    write_json(ledger(run), folder / "ledger.json")
    write_cloud(run.fused, folder / "stitched.ply")
    write_residuals(run, folder / "residuals.parquet")


def write_with_page(run: Run, folder: Path) -> None:
    """The same and report.html."""
    write_run(run, folder)
    extend("stitch.reports", run, folder / "report.html")
