"""A review that runs, and what speaks to it."""

import http.client
import json
import os
import queue
import subprocess
import sys
import threading
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest

from stitch.output.comparison.residual_tables import compare_surfaces, comparison_document
from stitch.output.json_file import write_json
from stitch.output.stored_run import load_run


class Server:
    """`stitch review RUN`, and requests to it; paths lie below the token."""

    def __init__(self, process, address):
        self.process, self.address = process, address
        self.place, self.token = urlsplit(address).netloc, urlsplit(address).path.strip("/")

    def ask(self, method, path, body=None, **headers):
        """Status and body of an answer, JSON where it is; `path` from the root of the server."""
        connection = http.client.HTTPConnection(self.place, timeout=60)
        text = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        connection.request(method, path, text, {name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        told = answer.read()
        connection.close()
        is_json = (answer.getheader("content-type") or "").startswith("application/json")
        return answer.status, json.loads(told) if is_json else told.decode()

    def get(self, path):
        return self.ask("GET", f"/{self.token}/{path}")

    def post(self, path, body):
        return self.ask("POST", f"/{self.token}/{path}", body)

    def state(self):
        return self.get("state")[1]

    def listen(self):
        """What one open page hears, as it comes."""
        heard, connection = queue.Queue(), http.client.HTTPConnection(self.place, timeout=120)
        connection.request("GET", f"/{self.token}/events")
        answer = connection.getresponse()

        def read():
            try:
                for line in answer:
                    if line.startswith(b"data: "):
                        heard.put(json.loads(line[6:]))
            except (OSError, ValueError, http.client.HTTPException):
                return

        threading.Thread(target=read, daemon=True).start()
        return heard


def until(heard, wanted, seconds=90):
    """The first event that is wanted."""
    while True:
        event = heard.get(timeout=seconds)
        if wanted(event):
            return event


def ended(number):
    """Whether an event is the end of a command."""
    return lambda e: (
        e["type"] == "job" and e["job"]["number"] == number and e["job"]["state"] not in ("waiting", "running")
    )


@contextmanager
def served(run, *options):
    """A review of a run folder."""
    words = [sys.executable, "-P", "-c", "from stitch.cli.main import main; main()", "review", str(run), "--no-browser"]
    limited = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen([*words, *options], stderr=subprocess.PIPE, text=True, env=limited)
    try:
        yield Server(process, process.stderr.readline().strip())
    finally:
        process.terminate()
        process.wait(20)
        process.stderr.close()


def compare_without_picture(run):
    """compare.json as `stitch compare` writes it."""
    write_json(comparison_document(compare_surfaces(load_run(run))), run / "compare.json")


@pytest.fixture(scope="package")
def small_run(_blade_on_disk, tmp_path_factory, stitch_command):
    """A run of three views with compare.json."""
    folder = tmp_path_factory.mktemp("review") / "r"
    stitch_command("run", _blade_on_disk, "-o", folder, "--no-recording")
    compare_without_picture(folder)
    return folder
