"""The command line as Windows would run it: `python tests/as_on_windows.py run SESSION -o RUN`.

What Windows forbids fails here too: to remove, replace or rename a file that is open or mapped, or a folder with such a
file in it; to wait for a file that was opened for reading; links without a privilege; names that Windows has not. What
it lacks is missing: fcntl, resource, the uids, process groups, O_NOFOLLOW, the C library without a name. Standard
output knows the letters of Western Europe only, and text without a stated encoding is an error.
"""

import builtins
import ctypes
import errno
import fcntl
import os
import re
import subprocess  # noqa: F401  # takes a machine with msvcrt for Windows, if it is asked later
import sys
from types import SimpleNamespace

_NO_NAME = re.compile(r'[<>:"|?*\x00-\x1f]|[. ]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)', re.IGNORECASE)
_NO_MODULES = ("fcntl", "resource", "pwd", "grp", "termios")
_LACKING = ("geteuid", "getuid", "killpg", "setsid", "fork", "O_NOFOLLOW", "sched_getaffinity", "mkfifo")


def behave_as_windows() -> None:
    """Replace functions of this process by ones that fail where those of Windows fail."""
    sys.modules["msvcrt"] = SimpleNamespace(LK_NBLCK=2, locking=_lock_a_byte)
    load_module = builtins.__import__

    def imported(name, globals=None, *arguments, **names):
        # Packages of this system's wheels may have them.
        if name in _NO_MODULES and (globals or {}).get("__name__", "").startswith(("stitch", "viz", "data_synth")):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return load_module(name, globals, *arguments, **names)

    builtins.__import__ = imported
    for name in _LACKING:
        if hasattr(os, name):
            delattr(os, name)
    unlink, rename, replace, rmdir = os.unlink, os.rename, os.replace, os.rmdir
    mkdir, link, fsync, open_file = os.mkdir, os.link, os.fsync, os.open

    def removed(path, *, dir_fd=None):
        _refuse_open(path, dir_fd)
        unlink(path, dir_fd=dir_fd)

    def folder_removed(path, *, dir_fd=None):
        _refuse_open(path, dir_fd)
        rmdir(path, dir_fd=dir_fd)

    def renamed(old, new, **folders):
        _refuse_open(old)
        if os.path.lexists(new):
            raise FileExistsError(errno.EEXIST, "Cannot create a file when that file already exists", str(old))
        _refuse_name(new)
        rename(old, new, **folders)

    def replaced(old, new, **folders):
        _refuse_open(old)
        _refuse_open(new)
        if os.path.isdir(new):
            raise PermissionError(errno.EACCES, "Access is denied", str(old))
        _refuse_name(new)
        replace(old, new, **folders)

    def made(path, *arguments, **folders):
        _refuse_name(path)
        mkdir(path, *arguments, **folders)

    def opened(path, flags, *arguments, **folders):
        if os.path.isdir(path) and folders.get("dir_fd") is None and not flags & os.O_DIRECTORY:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        if flags & os.O_CREAT:
            _refuse_name(path)
        return open_file(path, flags, *arguments, **folders)

    def waited_for(descriptor):
        with open(f"/proc/self/fdinfo/{descriptor}", encoding="ascii") as told:
            flags = int(told.read().split("flags:")[1].split()[0], 8)
        if flags & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        fsync(descriptor)

    def linked(source, place, *, follow_symlinks=True, **folders):
        if not follow_symlinks:
            raise NotImplementedError("link: follow_symlinks unavailable on this platform")
        link(source, place, **folders)

    def no_link(source, place, *_, **__):
        raise OSError(errno.EPERM, "A required privilege is not held by the client", str(source), None, str(place))

    os.unlink = os.remove = removed
    os.rmdir = folder_removed
    os.rename, os.replace, os.mkdir, os.open = renamed, replaced, made, opened
    os.link, os.symlink, os.fsync = linked, no_link, waited_for
    load = ctypes.CDLL.__init__

    def loaded(self, name, *arguments, **options):
        if name is None:
            raise TypeError("LoadLibrary() argument 1 must be str, not None")
        load(self, name, *arguments, **options)

    ctypes.CDLL.__init__ = loaded


def _lock_a_byte(descriptor, _, count):
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, count)
    except BlockingIOError:
        raise PermissionError(errno.EACCES, "Permission denied") from None


def _refuse_open(path, dir_fd=None):
    """Raise what Windows raises where a file is open or mapped, or is in the folder that moves."""
    folder = os.readlink(f"/proc/self/fd/{dir_fd}") if dir_fd is not None else os.getcwd()
    place = os.path.join(folder, os.fspath(path))
    held = set()
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            file = os.readlink(f"/proc/self/fd/{descriptor}")
        except OSError:
            continue
        if os.path.isfile(file):
            held.add(file)
    with open("/proc/self/maps", encoding="utf-8") as maps:
        held |= {line.split(maxsplit=5)[5].rstrip("\n") for line in maps if line.count("/")}
    place = os.path.join(os.path.realpath(os.path.dirname(place)), os.path.basename(place))
    for file in held:
        if file == place or file.startswith(place + os.sep):
            raise PermissionError(
                errno.EACCES,
                "The process cannot access the file because it is being used by another process",
                str(path),
            )


def _refuse_name(path):
    name = os.path.basename(os.fspath(path))
    if _NO_NAME.search(name):
        raise OSError(errno.EINVAL, "The filename, directory name, or volume label syntax is incorrect", str(path))


if __name__ == "__main__":
    sys.path.pop(0)
    behave_as_windows()
    from stitch.__main__ import main

    main()
