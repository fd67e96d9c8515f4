"""Who may ask: a browser on this machine that knows the token; and what a page of ours may load."""

import hmac

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# A name that resolves to 127.0.0.1 may belong to somebody else (DNS rebinding).
HOSTS = ("127.0.0.1", "localhost")
LARGEST_BODY = 200_000  # bytes
_PAGE = (
    "default-src 'none'; script-src 'self'; style-src 'nonce-{nonce}'; img-src 'self' data:; connect-src 'self'; "
    "frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# The Rerun viewer is WebAssembly with a script and styles of its own; it reaches this server alone.
_VIEWER = (
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


class Guard:
    """Answers nobody who does not name this machine and the token; passes the rest on below the token."""

    def __init__(self, app: ASGIApp, token: str, nonce: str) -> None:
        self.app, self.prefix, self.nonce = app, f"/{token}", nonce

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, or refuse."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers, path = Headers(scope=scope), scope["path"]
        refused = self._refused(headers, path)
        if refused is not None or scope["type"] != "http":
            await PlainTextResponse(*(refused or ("not found", 404)))(scope, receive, send)
            return
        inner = path[len(self.prefix) :] or "/"
        policy = _VIEWER if inner.startswith("/rerun/") else _PAGE.format(nonce=self.nonce)
        more = {
            "content-security-policy": policy,
            "referrer-policy": "no-referrer",
            "x-content-type-options": "nosniff",
            "cross-origin-resource-policy": "same-origin",
        }

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in more.items())]
            await send(message)

        await self.app(scope | {"path": inner, "raw_path": inner.encode()}, receive, answer)

    def _refused(self, headers: Headers, path: str) -> tuple[str, int] | None:
        host = headers.get("host", "")
        if host.partition(":")[0] not in HOSTS:
            return "this address is not mine", 421
        origin = headers.get("origin")
        if origin is not None and origin != f"http://{host}":
            return "a page from elsewhere", 403
        known = path[: len(self.prefix)]
        if not hmac.compare_digest(known.encode(), self.prefix.encode()) or path[len(self.prefix) :][:1] not in (
            "",
            "/",
        ):
            return "not found; open the address that stitch review printed", 404
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > LARGEST_BODY:
            return f"more than {LARGEST_BODY} bytes", 413
        return None
