"""The server of the page: its files, and the websocket by which the page and the simulation talk."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import string
import threading
import time
from html import escape
from pathlib import Path
from typing import Any

import uvicorn
from plotly.offline import get_plotlyjs
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from latentplan.reporting.page import read_part
from latentplan.view.access import PARAMETER, Access
from latentplan.view.hub import Hub, Page
from latentplan.view.pictures import LARGEST_BYTES

START_S = 10.0
STOP_S = 2.0
UNSUPPORTED_DATA = 1003  # code with which a websocket is closed after bytes (RFC 6455)
_FOLDER = Path(__file__).parent
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}


class ViewServer:
    """Serves the page in a thread of its own; `stop` ends it.

    Attributes:
        url: Address of the page, with the token where one is needed.
        hub: Passes messages between pages and simulation.

    Args:
        listening: Socket that listens for pages, see `listen`.
        title: Title of the page.
    """

    def __init__(self, listening: socket.socket, title: str) -> None:
        self._socket = listening
        host, port = listening.getsockname()[:2]
        self.access, self.hub = Access.of(host, port), Hub()
        name = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{port}/" + (f"?{PARAMETER}={self.access.token}" if self.access.token else "")
        config = uvicorn.Config(
            Guard(_make_app(title, self.access, self.hub), self.access),
            lifespan="off",
            log_config=None,
            access_log=False,
            ws="websockets-sansio",
            ws_max_size=2 * LARGEST_BYTES,  # a picture has a third more characters than bytes
            proxy_headers=False,
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), name="view", daemon=True)

    def start(self) -> None:
        """Starts to serve; returns once the page can be opened.

        Raises:
            RuntimeError: The server did not start.
        """
        self._thread.start()
        end = time.monotonic() + START_S
        while not self._server.started:
            if not self.is_alive or time.monotonic() > end:
                raise RuntimeError("the server of the live view did not start")
            time.sleep(0.01)

    @property
    def is_alive(self) -> bool:
        """Whether the server still serves."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """Closes all pages' connections and ends the server."""
        self._server.should_exit = True
        if self.is_alive:
            self._thread.join(STOP_S)
        self._socket.close()


class Guard:
    """Refuses what `Access` does not allow, with 403, before the application sees it.

    Args:
        app: The application.
        access: The rules.
    """

    def __init__(self, app: Any, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Handles one request or websocket."""
        is_socket = scope["type"] == "websocket"
        query = scope.get("query_string", b"").decode("latin-1")
        reason = self._access.refusal(Headers(scope=scope), query, is_socket=is_socket)
        if reason is None:
            await self._app(scope, receive, send)
        elif is_socket:
            await send({"type": "websocket.close", "code": 1008, "reason": reason})  # before it opens: 403
        else:
            await PlainTextResponse(f"{reason}\n", 403)(scope, receive, send)


def _make_app(title: str, access: Access, hub: Hub) -> Starlette:
    page = string.Template(_read("page.html")).substitute(title=escape(title))
    files = {
        "look.css": (read_part("page.css"), "text/css"),
        "live.css": (_read("live.css"), "text/css"),
        "theme.js": (read_part("theme.js"), "text/javascript"),
        "live.js": (_read("live.js"), "text/javascript"),
        "plotly.js": (get_plotlyjs(), "text/javascript"),
    }

    async def show(request: Request) -> Response:
        if not access.brings_token(request.url.query):
            return Response(page, media_type="text/html", headers=_HEADERS)
        answer = RedirectResponse("/", 303, headers=_HEADERS)
        answer.set_cookie(access.cookie, access.token or "", httponly=True, samesite="lax")
        return answer

    async def send_file(request: Request) -> Response:
        found = files.get(request.path_params["name"])
        if found is None:
            return PlainTextResponse("there is no such file\n", 404)
        return Response(found[0], media_type=found[1], headers=_HEADERS)

    async def talk(websocket: WebSocket) -> None:
        await websocket.accept()
        opened = Page()
        hub.open(opened)
        sending = asyncio.create_task(_send_all(websocket, opened))
        try:
            while (message := await websocket.receive())["type"] == "websocket.receive":
                if message.get("text") is None:
                    with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # the page has gone meanwhile
                        await websocket.close(UNSUPPORTED_DATA)
                    break
                hub.ask(opened, message["text"])
        finally:
            hub.close(opened)
            sending.cancel()

    return Starlette(routes=[Route("/", show), Route("/{name}", send_file), WebSocketRoute("/live", talk)])


async def _send_all(websocket: WebSocket, page: Page) -> None:
    """Sends a page its messages until it is closed."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # the page has gone while a message was sent
        while True:
            for text in await page.next_messages():
                await websocket.send_text(text)


def _read(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")
