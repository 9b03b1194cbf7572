"""The page that follows a watched session: its routes and server."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
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

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

    from levkas.workbench.watching.session import SessionState, WatchedSession

ASSETS = {"watch.js": "text/javascript", "watch.css": "text/css"}


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

    def publish(self, state: SessionState) -> None:
        """Show a state from now on."""
        self.state, self.version = state, self.version + 1

    def news(self, known: int) -> dict[str, Any]:
        """Return the version, and the session where that is not the known one; JSON-ready."""
        version, state = self.version, self.state
        if state is None or version == known:
            return {"version": version}
        folder = self.session.watch.root.name
        return {"version": version, "session": {**plain(state.to_dict()), "folder": folder}}


def make_watch_app(
    board: SessionBoard, *, port: int, token: str, entered: Callable[[], object] = lambda: None
) -> App:
    """Return the application of the page, behind the workbench's guard."""
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.responses import HTMLResponse, JSONResponse, Response
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
        known = request.query_params.get("known", "")
        return JSONResponse({"ok": True, **board.news(int(known) if known.isdecimal() else -1)})

    table = [
        Route("/", routes.answering(page), methods=["GET"]),
        Route("/assets/{name}", routes.answering(asset), methods=["GET"]),
        Route("/enter", routes.answering(enter), methods=["POST"]),
        Route("/api/session", routes.answering(session), methods=["GET"]),
        Route("/api/picture", routes.answering(picture), methods=["GET"]),
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
