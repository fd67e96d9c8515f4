"""Answers of a review as JSON, and requests that bring it."""

import json
import sys
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from stitch.output.json_file import without_nan

LARGEST_BODY = 200_000  # bytes


async def json_object(request: Request) -> dict[str, Any] | None:
    """The JSON object of a request; None where it brings something else: too much, too deep, no number or no text."""
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > LARGEST_BODY:
            return None
    try:
        found = json.loads(body)
        # Half an emoji is no text of a command, nor is 1e400 a number.
        json.dumps(found, allow_nan=False, ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def json_response(value: Any) -> Response:
    """Plain data; what is not known is null."""
    return JSONResponse(without_nan(value))


def error_response(text: str, status: int = 400) -> Response:
    """One line for the page."""
    return JSONResponse({"problem": text}, status_code=status)


def refusal_response(error: Exception) -> Response:
    """Return the message of a refused input."""
    return error_response(str(error), 422)


async def fault(_: Request, error: Exception) -> Response:
    """A fault of the program: one line for the page and the terminal."""
    text = f"unexpected {type(error).__name__}: {error}; a fault of stitch"
    print(f"stitch: {text}", file=sys.stderr, flush=True)
    return error_response(text, 500)
