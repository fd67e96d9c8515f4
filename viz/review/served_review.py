"""What `stitch review` does: one server on this machine alone, and a browser on its page."""

import secrets
import socket
import sys
import webbrowser
from pathlib import Path

import uvicorn

from stitch.errors import InputError
from stitch.stored.stored_run import read_documents
from viz.review.run_review import RunReview
from viz.review.web_app import review_app

_HERE = "127.0.0.1"
# Seconds that open pages have to go when the program ends.
_GRACE = 1


def served_review(run: Path, port: int, *, browser: bool, effects_file: Path | None, trust: bool) -> None:
    """Serve until Ctrl-C.

    Raises:
        InputError: no run, no such file of effects, or a port that is taken.
    """
    read_documents(run)
    if effects_file is not None and not effects_file.is_file():
        raise InputError(f"{effects_file}: no such file; --effects-file names a Python file with @effect functions")
    token, nonce = secrets.token_urlsafe(24), secrets.token_urlsafe(16)
    listening = _socket(port)
    address = f"http://{_HERE}:{listening.getsockname()[1]}/{token}/"
    found = RunReview(run.resolve(), None if effects_file is None else effects_file.resolve(), trust)
    config = uvicorn.Config(
        review_app(found, token, nonce),
        log_level="critical",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=_GRACE,
    )
    print(f"  {address}", file=sys.stderr, flush=True)
    opened = browser and webbrowser.open(address)
    how = "Ctrl-C ends it." if opened else "Open this address in a browser on this machine; Ctrl-C ends it."
    print(how, file=sys.stderr, flush=True)
    uvicorn.Server(config).run(sockets=[listening])


def _socket(port: int) -> socket.socket:
    """A socket of this machine alone.

    Raises:
        InputError: the port is taken, or not ours.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((_HERE, port))
        listening.listen()  # a browser that comes before the server has begun waits
    except OSError as error:
        listening.close()
        raise InputError(f"--port {port}: {error.strerror}; to fix: name another, or leave it out") from None
    return listening
