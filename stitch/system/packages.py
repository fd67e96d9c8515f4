"""What this package is called where packages are installed, and the line that says how one that is missing comes.

`import stitch` and the command `stitch` belong to the distribution DISTRIBUTION: on PyPI, `stitch` is somebody else's.
"""

import logging
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from threading import get_ident
from typing import Any

from stitch.errors import InputError

DISTRIBUTION = "stitch-scans"
# What matches points and fits a hand-eye without page, recording, table or simulator: a third of a gigabyte.
SMALL = (
    *("numpy", "scipy", "pykdtree", "threadpoolctl", "tomli-w", "typer", "rich", "pyyaml"),
    *("jsonschema", "natsort", "python-neo-lzf"),
)
# Packages by the name under which they are installed: that of their import, and what is not there without them.
PACKAGES = {
    "numpy": ("numpy", "everything"),
    "scipy": ("scipy", "everything"),
    "pykdtree": ("pykdtree", "everything that matches points"),
    "threadpoolctl": ("threadpoolctl", "everything"),
    "tomli-w": ("tomli_w", "model.toml, and so every result"),
    "typer": ("typer", "the commands"),
    "rich": ("rich", "the commands"),
    "pyyaml": ("yaml", "poses and intrinsics as YAML"),
    "python-neo-lzf": ("lzf", "scans as PCD"),
    "natsort": ("natsort", "init: the order of files"),
    "pyarrow": ("pyarrow", "residuals.parquet"),
    "jsonschema": ("jsonschema", "the check of result.json when a run is read again"),
    "libigl": ("igl", "the part as a surface, --mesh, measure, fit, seam"),
    "kiss-icp": ("kiss_icp", "the start of the hand-eye of a scanner that never stops"),
    "trimesh": ("trimesh", "scans as meshes, CAD, the simulator"),
    "embreex": ("embreex", "a simulator of full speed"),
    "manifold3d": ("manifold3d", "the simulator's parts"),
    "scikit-fem": ("skfem", "the simulated panel cell"),
    "rerun-sdk": ("rerun", "the recording and its viewer"),
    "matplotlib": ("matplotlib", "figures and pages"),
    "pillow": ("PIL", "pictures and depth images"),
    "jinja2": ("jinja2", "pages"),
    "starlette": ("starlette", "review in a browser, serve"),
    "uvicorn": ("uvicorn", "review in a browser, serve"),
    "open3d": ("open3d", "--mesh watertight and light, compare --with open3d, clouds to Open3D"),
    "pye57": ("pye57", "clouds as E57"),
    "laspy": ("laspy", "clouds as LAS and LAZ"),
    "h5py": ("h5py", "scans as ZDF of Zivid"),
    "openexr": ("OpenEXR", "depth images as EXR"),
    "python-calamine": ("python_calamine", "tables as workbooks"),
    "opencv-python-headless": ("cv2", "boards in scans, lenses that distort, holes in pictures"),
    "rosbags": ("rosbags", "bags of ROS, and MCAP"),
    "distributed": ("distributed", "batch on more than one process"),
    "cryptography": ("cryptography", "batch on more than one process"),
    "fsspec": ("fsspec", "sessions and runs in object storage"),
    "pandas": ("pandas", "tables of results for pandas"),
}


def stitch_version() -> str:
    """Return the version that is installed."""
    from importlib.metadata import version  # a third of `import stitch`, which needs none

    return version(DISTRIBUTION)


@cache
def arrow_alone() -> Any:
    """Return the module pyarrow, kept from importing pandas.

    At its first list pyarrow looks once for pandas, to recognise columns of its types. Where pandas is installed that
    takes a third of a second, and no such column comes here. Other threads can import pandas meanwhile.
    """
    import pyarrow

    asking = get_ident()

    class NoPandas:
        """A finder of modules that refuses pandas to this thread and leaves all else to the finders after it."""

        def find_spec(self, name: str, *_: object) -> None:
            if name == "pandas" and get_ident() == asking:
                raise ModuleNotFoundError(name=name)

    finder: Any = NoPandas()
    sys.meta_path.insert(0, finder)
    try:
        pyarrow.array([0])
    finally:
        sys.meta_path.remove(finder)
    return pyarrow


def command_for(extra: str) -> str:
    """Return the command that installs what an extra of this package brings."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def small_requirements() -> list[str]:
    """Return the packages of SMALL as requirements for pip, with the versions that this distribution asks for.

    NumPy may be as old as 1.26: only the recording asks for a newer one, and it is not in SMALL.
    """
    from importlib.metadata import requires

    # Name in small letters to requirement with its versions.
    asked = {re.match(r"[\w.-]+", line)[0].lower(): line for line in requires(DISTRIBUTION) or ()}  # type: ignore[index]
    return ["numpy>=1.26" if name == "numpy" else asked[name] for name in SMALL]


def command_of(name: str) -> str:
    """Return the pip command that installs one of PACKAGES: by the extra that brings it, else by its own name."""
    from importlib.metadata import requires

    for requirement in requires(DISTRIBUTION) or ():
        asked, _, marker = requirement.partition(";")
        if re.match(r"[\w.-]+", asked)[0].lower() == name:  # type: ignore[index]
            extra = re.search(r"""extra == ["'](.+?)["']""", marker)
            return command_for(extra[1]) if extra else f"pip install '{asked.strip()}'"
    return f"pip install {name}"


def missing_package(error: ModuleNotFoundError) -> str | None:
    """Return a line that names the package an import did not find, and how to install it.

    None where that is none of PACKAGES, so that the error is a mistake of the program.
    """
    top = (error.name or "").partition(".")[0].replace("markupsafe", "jinja2")  # which brings it
    for name, (module, purpose) in PACKAGES.items():
        if module == top:
            return f"needs {name}, which is not installed ({purpose}); to fix: {command_of(name)}"
    return None


@contextmanager
def unless_missing() -> Iterator[None]:
    """End the block early, with a warning of the logger `stitch`, where one of PACKAGES is not installed.

    For pictures, pages and recordings: numbers come without them.

    Raises:
        ModuleNotFoundError: of a module that is none of PACKAGES.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        line = missing_package(error)
        if line is None:
            raise
        logging.getLogger("stitch").warning("Left out: it %s", line)


def import_extra(name: str, where: Path | str, extra: str) -> Any:
    """Return the imported module of an optional package.

    Args:
        name: of its module.
        where: the file, the flag or the function that needs it, for the message.
        extra: of this distribution, by which pip installs the package.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"{where}: needs the package {name}; to fix: {command_for(extra)}") from None
