"""Open3D, loaded where it is used: the import takes over a second and needs a library of its own."""

import ctypes
from types import ModuleType


def load_open3d() -> ModuleType:
    """Import Open3D; where the system has no libusb-1.0, the one of the package libusb-package serves."""
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        import libusb_package

        path = libusb_package.get_library_path()
        if path:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    import open3d

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
