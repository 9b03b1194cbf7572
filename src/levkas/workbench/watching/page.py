"""The page that follows a watched session: its routes, events and server."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from secrets import token_urlsafe
from typing import TYPE_CHECKING, Any

from levkas.core.json_safe import plain
from levkas.core.problems import Problem
from levkas.pages.screen import read_built
from levkas.workbench.library import FrameMissing
from levkas.workbench.server.app import (
    TOKEN_BYTES,
    Address,
    OpeningPage,
    ServerRefused,
    listen_on,
    server_of,
)
from levkas.workbench.server.guard import App, Guard, cookie_of
from levkas.workbench.watching.files import fresh_of

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

    from levkas.workbench.watching.files import FrameState
    from levkas.workbench.watching.session import SessionState, WatchedSession

ASSETS = {"watch.js": "text/javascript", "watch.css": "text/css"}
BEAT_S, ALIVE_S = 0.2, 15.0
"""How often a browser's stream looks for news; and after which silence it says that it is alive."""


@dataclass
class SessionBoard:
    """The newest state of a session, for every browser that follows it.

    Parameters
    ----------
    session : WatchedSession
        Its pictures are shown.
    """

    session: WatchedSession
    version: int = 0
    state: SessionState | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def publish(self, state: SessionState) -> None:
        """Show a state from now on."""
        with self._lock:
            self.state, self.version = state, self.version + 1

    def news(self, shown: dict[str, FrameState]) -> dict[str, Any] | None:
        """Return what a browser has not shown yet, JSON-ready, and note it in `shown`; None before the first state."""
        with self._lock:
            state = self.state
        if state is None:
            return None
        fresh = {frame.file.name: frame for frame in fresh_of(state.frames, shown)}
        gone = sorted(shown.keys() - {f.file.name for f in state.frames})
        shown.update(fresh)
        for name in gone:
            del shown[name]
        record = state.to_dict()
        record["frames"] = [frame.to_dict() for frame in fresh.values()]
        return {**record, "gone": gone, "folder": self.session.watch.root.name}

    async def events(self) -> AsyncIterator[str]:
        """Yield server-sent events: at first the whole session, then what changes."""
        shown: dict[str, FrameState] = {}
        version, silent = 0, 0.0
        while True:
            if self.version != version:
                version, silent = self.version, 0.0
                news = await asyncio.to_thread(self.news, shown)
                if news is not None:
                    yield f"data: {json.dumps(plain(news), ensure_ascii=False)}\n\n"
            elif silent >= ALIVE_S:
                silent = 0.0
                yield ": alive\n\n"
            silent += BEAT_S
            await asyncio.sleep(BEAT_S)


def make_watch_app(
    board: SessionBoard, *, port: int, token: str, entered: Callable[[], object] = lambda: None
) -> App:
    """Return the application of the page, behind the workbench's guard."""
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
    from starlette.routing import Route

    from levkas.workbench.server import routes

    def page(request: Request, body: dict[str, Any]) -> Response:
        return HTMLResponse(routes.page_of("Levkas: the session", "watch"))

    def asset(request: Request, body: dict[str, Any]) -> Response:
        return routes.asset(request, ASSETS)

    def enter(request: Request, body: dict[str, Any]) -> Response:
        return routes.enter(body, token, cookie_of(port), entered)

    def picture(request: Request, body: dict[str, Any]) -> Response:
        data = board.session.picture_of(request.query_params.get("name", ""))
        if data is None:
            raise FrameMissing(Problem("E_NO_FILE", "there is no such frame"))
        return Response(data, media_type="image/png")

    def session(request: Request, body: dict[str, Any]) -> Response:
        return JSONResponse(plain({"ok": True, **(board.news({}) or {})}))

    async def events(request: Request) -> Response:
        return StreamingResponse(board.events(), media_type="text/event-stream")

    table = [
        Route("/", routes.answering(page), methods=["GET"]),
        Route("/assets/{name}", routes.answering(asset), methods=["GET"]),
        Route("/enter", routes.answering(enter), methods=["POST"]),
        Route("/api/session", routes.answering(session), methods=["GET"]),
        Route("/api/picture", routes.answering(picture), methods=["GET"]),
        Route("/api/events", events, methods=["GET"]),
    ]
    inner = Starlette(routes=table, exception_handlers={HTTPException: routes.refuse_http})
    inner.router.redirect_slashes = False
    return Guard(inner, port=port, token=token)


class WatchServer:
    """Serves the page of a session from a thread, until it is stopped.

    Parameters
    ----------
    board : SessionBoard
    port : int
        0: any that is free.

    Raises
    ------
    ServerRefused
        Where the port is taken.
    levkas.pages.screen.ScreenMissing
        Where the pages were not built.
    """

    def __init__(self, board: SessionBoard, port: int = 0) -> None:
        for name in ASSETS:
            read_built(name)
        self._socket = listen_on(port)
        self.address = Address(self._socket.getsockname()[1], token_urlsafe(TOKEN_BYTES))
        self.opening = OpeningPage(self.address)
        app = make_watch_app(
            board, port=self.address.port, token=self.address.token, entered=self.opening.remove
        )
        self._server = server_of(app)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End the server and take the opening page away."""
        self._server.should_exit = self._server.force_exit = True
        self._thread.join(timeout=3)
        self.opening.remove()
        self._socket.close()


__all__ = ["ServerRefused", "SessionBoard", "WatchServer", "make_watch_app"]
