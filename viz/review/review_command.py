"""`stitch review RUN`: serve the review of a run to a browser on this machine."""

import secrets
import socket
import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer
import uvicorn

from stitch.cli.options import EffectsFile, Trust
from stitch.errors import InputError
from stitch.stored.run_documents import read_documents
from viz.review.run_review import RunReview
from viz.review.web_app import review_app

_HERE = "127.0.0.1"
# Seconds that open pages have to go when the program ends.
_GRACE = 1


def review(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port to listen on; default a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open a browser.")] = True,
    effects_file: EffectsFile = None,
    trust: Trust = False,
) -> None:
    """See in a browser where a run fails, add what is missing, and watch the error fall; ends with Ctrl-C.

    \b
    Examples:
      stitch review runs/blade-17
      stitch review runs/blade-17 --port 8080 --no-browser
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
    if browser:
        webbrowser.open(address)
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
