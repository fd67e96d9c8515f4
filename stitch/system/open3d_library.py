"""Open3D, imported where it is used and without its windows; what to install where it does not load.

Run by `make install`: prints the packages of the system that are missing, and says in one line what to install.
"""

import ctypes
import sys
from importlib import import_module
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from stitch.errors import InputError
from stitch.system.packages import command_for

# Libraries of the system that Open3D is linked with, used or not, and the packages of Debian and Ubuntu that have them.
_LIBRARIES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libudev.so.1": "libudev1",
    "libidn2.so.0": "libidn2-0",
}


def import_open3d(needed_by: str) -> Any:
    """Return a module with Open3D's geometry, pipelines and utility: its compiled part where that suffices, else all.

    All of Open3D takes 0.9 s and 220 MB to import, its compiled part `open3d.pybind` a third of both. After the latter
    `import open3d` still works, and gives the same types.

    Args:
        needed_by: the flag, the file or the function that needs it, for the message.

    Raises:
        InputError: it is not installed, or a library of the system is missing.
    """
    try:
        return _compiled_part() or import_module("open3d")
    except (ImportError, OSError) as error:
        why, remedy = _remedy(error)
        raise InputError(f"{needed_by}: {why}; to fix: {remedy}") from None


def _compiled_part() -> Any:
    """Return the compiled module open3d.pybind, imported without its package; None where that is not possible.

    That is where `open3d` is imported already or not installed, on Windows, and before Open3D 0.20.
    """
    if "open3d" in sys.modules or sys.platform == "win32":
        return None
    if (loaded := sys.modules.get("open3d.pybind")) is not None:
        return loaded
    spec = find_spec("open3d")
    if spec is None or spec.submodule_search_locations is None:
        return None
    # Importing open3d.pybind would run open3d/__init__.py first: an empty package stands in for it meanwhile.
    bare = ModuleType("open3d")
    bare.__path__, bare.__spec__ = list(spec.submodule_search_locations), spec
    sys.modules["open3d"] = bare
    try:
        return import_module("open3d.pybind") if find_spec("open3d.pybind") else None
    finally:
        del sys.modules["open3d"]


def _remedy(error: Exception) -> tuple[str, str]:
    """Return why Open3D cannot be imported and the command that mends it, from the error of the import."""
    if isinstance(error, ModuleNotFoundError):
        return "Open3D is not installed", command_for("open3d")
    if packages := missing_packages():
        names = [name for name, package in _LIBRARIES.items() if package in packages]
        return f"Open3D lacks {', '.join(names)} of the system", f"apt-get install {' '.join(packages)}"
    # Open3D has several distributions of the same files: install again the one that is there, open3d or open3d-cpu.
    there = next(iter(packages_distributions().get("open3d", ["open3d"])))
    return f"Open3D cannot be imported ({error})", f"pip install --force-reinstall {there}"


def missing_packages() -> list[str]:
    """Return the packages of the system that Open3D lacks here, as Debian and Ubuntu name them."""
    if sys.platform != "linux":
        return []
    return [package for library, package in _LIBRARIES.items() if not _loads(library)]


def _loads(library: str) -> bool:
    """Return whether the system can load a library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


if __name__ == "__main__":
    try:
        import_open3d("Open3D")
    except InputError as refusal:
        print(*missing_packages())
        print(f"{refusal} (stitch does the rest without it)", file=sys.stderr)
