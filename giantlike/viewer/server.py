"""The viewer in a browser: pages of a run on the loopback interface, behind a token."""

from __future__ import annotations

import html
import json
import secrets
from collections.abc import Awaitable, Callable, Mapping
from importlib.resources import files
from inspect import Parameter, signature
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from giantlike.core.arrays import require
from giantlike.core.errors import InputError, OpNavError
from giantlike.viewer.answers import Answers
from giantlike.viewer.session import Session

LOOPBACK = "127.0.0.1"
_NAMES = frozenset({LOOPBACK, "localhost"})
"""Names under which the page may be called: another one is a foreign page that points at this machine."""
_POLICY = "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:"
"""The page may load nothing from elsewhere, and runs no script but that of its own file."""
_PARTS: Mapping[str, str] = MappingProxyType({"view.js": "text/javascript", "view.css": "text/css"})
"""Files of the page, with their media types."""
_MAX_BODY = 400_000
"""Maximum size of a request, bytes: two thousand edits of points, or one with a reason and a drawn area."""


def application(session: Session, token: str, other: Session | None = None) -> Starlette:
    """Make the web application of a run, and of another one to blink against."""
    answers, beside = Answers(session), None if other is None else Answers(other)

    def run() -> dict[str, Any]:
        return answers.run() | {"other": None if beside is None else beside.places()}

    async def page(request: Request) -> Response:
        answer = HTMLResponse(_part("view.html").replace("{{ token }}", html.escape(token)))
        answer.set_cookie(_cookie(request), token, httponly=True, samesite="strict")
        return answer

    async def part(request: Request) -> Response:
        name = str(request.url.path).removeprefix("/")
        return Response(_part(name), media_type=_PARTS[name])

    def reading(answer: Callable[..., Any], kind: str = "json") -> Callable[[Request], Awaitable[Response]]:
        async def handle(request: Request) -> Response:
            arguments = dict(request.path_params) | dict(request.query_params)
            arguments.pop("token", None)
            known = signature(answer).parameters
            unknown = arguments.keys() - known.keys()
            require(not unknown, f"there is no argument {', '.join(sorted(unknown))}")
            missing = [name for name in known if known[name].default is Parameter.empty and name not in arguments]
            require(not missing, f"the argument {', '.join(missing)} is missing")
            content = await run_in_threadpool(answer, **arguments)
            return JSONResponse(content) if kind == "json" else Response(content, media_type=kind)

        return handle

    def changing(answer: Callable[..., Any]) -> Callable[[Request], Awaitable[Response]]:
        async def handle(request: Request) -> Response:
            if not _same(request.headers.get("x-token", ""), token):
                return PlainTextResponse("the token is missing", status_code=403)
            return JSONResponse(await run_in_threadpool(answer, await _body(request)))

        return handle

    routes = [
        Route("/", page),
        *(Route(f"/{name}", part) for name in _PARTS),
        Route("/api/run", reading(run)),
        Route("/api/image/{index:int}", reading(answers.image)),
        Route("/api/terminator/{index:int}", reading(answers.terminator)),
        Route("/api/compare", reading(answers.compare)),
        Route("/api/points", reading(answers.points)),
        Route("/api/pixel/{index:int}", reading(answers.pixel)),
        Route("/api/edit", changing(answers.edit), methods=["POST"]),
        Route("/api/solve", changing(answers.solve), methods=["POST"]),
        Route("/api/solve", reading(answers.solving)),
        Route("/picture/{index:int}.png", reading(answers.picture, "image/png")),
        Route("/thumbnail/{index:int}.jpg", reading(answers.thumbnail, "image/jpeg")),
        Route("/chart/{index:int}.svg", reading(answers.chart, "image/svg+xml")),
    ]
    if beside is not None:
        routes.append(Route("/other/image/{index:int}", reading(beside.image)))
        routes.append(Route("/other/picture/{index:int}.png", reading(beside.picture, "image/png")))

    async def refuse(request: Request, error: Exception) -> Response:
        text = " ".join(str(error).split()).encode("utf-8", "backslashreplace")
        return PlainTextResponse(text, status_code=400)

    return Starlette(
        routes=routes, middleware=[Middleware(_Gate, token=token)], exception_handlers={OpNavError: refuse}
    )


def _part(name: str) -> str:
    return (files("giantlike.viewer") / name).read_text(encoding="utf-8")


def _cookie(request: Request) -> str:
    """Name of the cookie: cookies are shared by all ports of a machine, and each run has its own port."""
    port = request.headers.get("host", "").rpartition(":")[2]
    return f"giantlike_token_{port if port.isascii() and port.isdecimal() else 'default'}"


async def _body(request: Request) -> dict[str, Any]:
    """The JSON object that a request sends."""
    sent = bytearray()
    async for chunk in request.stream():
        sent += chunk
        require(len(sent) <= _MAX_BODY, f"a request has at most {_MAX_BODY} bytes")
    try:
        content = json.loads(bytes(sent))
    except (ValueError, RecursionError) as error:
        raise InputError(f"a JSON object is needed: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"a JSON object is needed, got a {type(content).__name__}")
    return content


def _same(shown: str, token: str) -> bool:
    return secrets.compare_digest(shown.encode(), token.encode())


class _Gate(BaseHTTPMiddleware):
    """Lets requests in that call the machine by a loopback name and show the token."""

    def __init__(self, app: Any, token: str) -> None:
        super().__init__(app)
        self._token = token

    async def dispatch(self, request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        shown = request.query_params.get("token") or request.cookies.get(_cookie(request)) or ""
        name = request.headers.get("host", "").rpartition(":")[0] or request.headers.get("host", "")
        if name not in _NAMES or not _same(shown, self._token):
            return PlainTextResponse("open the address that giantlike view printed, with its token", status_code=403)
        answer = await call_next(request)
        answer.headers["Cache-Control"] = "no-store"
        answer.headers["Content-Security-Policy"] = _POLICY
        return answer


def serve(
    run: Path, *, campaign: Path | None, port: int, announce: Callable[[str], None], other: Path | None = None
) -> None:
    """Serve the viewer of a run, and of another one to blink against, until it is interrupted."""
    import socket

    import uvicorn

    token = secrets.token_urlsafe(24)
    app = application(Session(run, campaign), token, None if other is None else Session(other))
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((LOOPBACK, port))
        address = cast(tuple[str, int], listener.getsockname())
        announce(f"http://{LOOPBACK}:{address[1]}/?token={token}")
        server = uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False))
        server.run(sockets=[listener])
