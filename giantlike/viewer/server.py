"""The viewer in a browser: pages of a run on the loopback interface, behind a token."""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable
from importlib.resources import files
from inspect import signature
from pathlib import Path
from typing import Any, cast

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from giantlike.core.arrays import require
from giantlike.core.errors import OpNavError
from giantlike.viewer.answers import Answers
from giantlike.viewer.session import Session

LOOPBACK = "127.0.0.1"
_COOKIE = "giantlike_token"
_NAMES = frozenset({LOOPBACK, "localhost"})
"""Names under which the page may be called: another one is a foreign page that points at this machine."""
_POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; script-src 'self' 'unsafe-inline'; img-src 'self' data:"
)
"""The page may load nothing from elsewhere."""


def application(session: Session, token: str) -> Starlette:
    """Make the web application of a run."""
    answers = Answers(session)

    async def page(request: Request) -> Response:
        text = (files("giantlike.viewer") / "view.html").read_text(encoding="utf-8")
        answer = HTMLResponse(text.replace("{{ token }}", token))
        answer.set_cookie(_COOKIE, token, httponly=True, samesite="strict")
        return answer

    def reading(answer: Callable[..., Any], kind: str = "json") -> Callable[[Request], Awaitable[Response]]:
        async def handle(request: Request) -> Response:
            arguments = dict(request.path_params) | dict(request.query_params)
            arguments.pop("token", None)
            unknown = arguments.keys() - signature(answer).parameters.keys()
            require(not unknown, f"there is no argument {', '.join(sorted(unknown))}")
            content = await run_in_threadpool(answer, **arguments)
            return JSONResponse(content) if kind == "json" else Response(content, media_type=kind)

        return handle

    def changing(answer: Callable[..., Any]) -> Callable[[Request], Awaitable[Response]]:
        async def handle(request: Request) -> Response:
            if request.headers.get("x-token") != token:
                return PlainTextResponse("the token is missing", status_code=403)
            return JSONResponse(await run_in_threadpool(answer, await request.json()))

        return handle

    routes = [
        Route("/", page),
        Route("/api/run", reading(answers.run)),
        Route("/api/image/{index:int}", reading(answers.image)),
        Route("/api/terminator/{index:int}", reading(answers.terminator)),
        Route("/api/compare", reading(answers.compare)),
        Route("/api/pixel/{index:int}", reading(answers.pixel)),
        Route("/api/edit", changing(answers.edit), methods=["POST"]),
        Route("/api/solve", changing(answers.solve), methods=["POST"]),
        Route("/api/solve", reading(answers.solving)),
        Route("/picture/{index:int}.png", reading(answers.picture, "image/png")),
        Route("/thumbnail/{index:int}.jpg", reading(answers.thumbnail, "image/jpeg")),
        Route("/chart/{index:int}.svg", reading(answers.chart, "image/svg+xml")),
    ]

    async def refuse(request: Request, error: Exception) -> Response:
        return PlainTextResponse(" ".join(str(error).split()), status_code=400)

    return Starlette(
        routes=routes,
        middleware=[Middleware(_Gate, token=token)],
        exception_handlers={OpNavError: refuse},
    )


class _Gate(BaseHTTPMiddleware):
    """Lets requests in that call the machine by a loopback name and show the token."""

    def __init__(self, app: Any, token: str) -> None:
        super().__init__(app)
        self._token = token

    async def dispatch(self, request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        shown = request.query_params.get("token") or request.cookies.get(_COOKIE) or ""
        name = request.headers.get("host", "").rpartition(":")[0] or request.headers.get("host", "")
        if name not in _NAMES or not secrets.compare_digest(shown, self._token):
            return PlainTextResponse("open the address that giantlike view printed, with its token", status_code=403)
        answer = await call_next(request)
        answer.headers["Cache-Control"] = "no-store"
        answer.headers["Content-Security-Policy"] = _POLICY
        return answer


def serve(run: Path, *, campaign: Path | None, port: int, announce: Callable[[str], None]) -> None:
    """Serve the viewer of a run until it is interrupted."""
    import socket

    import uvicorn

    token = secrets.token_urlsafe(24)
    app = application(Session(run, campaign), token)
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((LOOPBACK, port))
        address = cast(tuple[str, int], listener.getsockname())
        announce(f"http://{LOOPBACK}:{address[1]}/?token={token}")
        server = uvicorn.Server(uvicorn.Config(app, log_level="warning", access_log=False))
        server.run(sockets=[listener])
