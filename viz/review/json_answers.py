"""Answers as JSON, and requests that bring it."""

import sys
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response


async def asked_object(request: Request) -> dict[str, Any] | None:
    """The JSON object of a request; None where it brings something else."""
    try:
        found = await request.json()
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def told(value: Any) -> Response:
    """Plain data; what is not known is null."""
    return JSONResponse(_finite(value))


def wrong(text: str, status: int = 400) -> Response:
    """One line for the page."""
    return JSONResponse({"problem": text}, status_code=status)


def refused(error: Exception) -> Response:
    """What stitch says of an input."""
    return wrong(str(error), 422)


async def fault(_: Request, error: Exception) -> Response:
    """A fault of the program: one line for the page and the terminal."""
    text = f"unexpected {type(error).__name__}: {error}; a fault of stitch"
    print(f"stitch: {text}", file=sys.stderr, flush=True)
    return wrong(text, 500)


def _finite(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and value - value != 0 else value
