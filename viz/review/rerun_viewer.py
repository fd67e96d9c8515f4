"""The Rerun web viewer that the rerun wheel ships, as files to serve: without a server of its own, nor the network."""

import os
import re
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path

from stitch.errors import NoResultError
from viz.viewer import rerun_program

NAMES = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico")
_HERE = "127.0.0.1"
_SECONDS = 30.0
# Fonts from elsewhere, which the viewer can do without.
_ELSEWHERE = re.compile(r"<link\b[^>]*https://[^>]*>", re.S)


class RerunViewer:
    """The viewer's files, fetched once from the program when they are first asked for."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._folder: Path | None = None

    def file(self, name: str) -> Path:
        """Path of one of its files.

        Raises:
            NoResultError: the program does not give it.
        """
        with self._lock:
            if self._folder is None:
                self._folder = _fetched()
        return self._folder / name

    def close(self) -> None:
        """Take the files away."""
        with self._lock:
            if self._folder is not None:
                shutil.rmtree(self._folder, ignore_errors=True)
                self._folder = None


def _fetched() -> Path:
    """A folder with the files, asked of the program's own web server, which ends at once."""
    folder = Path(tempfile.mkdtemp(prefix="stitch-review-"))
    pages, data = _free_port(), _free_port()
    words = ["--serve-web", "--bind", _HERE, "--web-viewer-port", str(pages), "--port", str(data)]
    quiet = os.environ | {"RERUN_ANALYTICS": "off"}
    try:
        served = subprocess.Popen(
            [rerun_program(), *words],
            env=quiet,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        raise NoResultError(f"the Rerun viewer could not be started ({error}); use `stitch view`") from None
    try:
        for name in NAMES:
            content = _asked(f"http://{_HERE}:{pages}/{name}")
            if name == "index.html":
                content = _ELSEWHERE.sub("", content.decode()).encode()
            (folder / name).write_bytes(content)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        _end(served)
    return folder


def _end(served: subprocess.Popen[bytes]) -> None:
    """With the launcher the program itself, which would outlive it."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(served.pid, signal.SIGKILL)
    else:
        served.kill()
    served.wait()


def _asked(address: str) -> bytes:
    """Fetch the answer of an address once a server listens there; no proxy between."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    end = time.monotonic() + _SECONDS
    while True:
        try:
            with direct.open(address, timeout=_SECONDS) as answer:
                return bytes(answer.read())
        except (urllib.error.URLError, ConnectionError, TimeoutError) as error:
            if time.monotonic() > end:
                raise NoResultError(f"the Rerun viewer does not answer ({error}); use `stitch view`") from None
            time.sleep(0.1)


def _free_port() -> int:
    with socket.socket() as free:
        free.bind((_HERE, 0))
        return int(free.getsockname()[1])
