"""The ASGI application of the workbench, and the server that runs it."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from secrets import token_urlsafe
from typing import TYPE_CHECKING, Any

from levkas.core.problems import Problem, Refused
from levkas.workbench.server.guard import App, Guard, cookie_of

if TYPE_CHECKING:
    import uvicorn

    from levkas.workbench.library import Library

TOKEN_BYTES = 32
HOST = "127.0.0.1"


class ServerRefused(Refused):
    """The server cannot start."""


@dataclass(frozen=True)
class Address:
    """Where the workbench is found.

    Parameters
    ----------
    port : int
    token : str
        Stands in the fragment of the address, which no browser sends to a server.
    """

    port: int
    token: str

    @property
    def url(self) -> str:
        """The address to open."""
        return f"http://{HOST}:{self.port}/#{self.token}"


def make_app(
    library: Library, *, port: int, token: str, entered: Callable[[], object] = lambda: None
) -> App:
    """Return the application for one campaign, behind its guard; `entered` as `routes` takes it."""
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException

    from levkas.workbench.server.routes import refuse_http, routes

    table = routes(library, token=token, cookie=cookie_of(port), entered=entered)
    inner = Starlette(routes=table, exception_handlers={HTTPException: refuse_http})
    inner.router.redirect_slashes = False
    return Guard(inner, port=port, token=token)


def serve(
    campaign: Path,
    *,
    output: Path | None = None,
    port: int = 0,
    browse: bool = False,
    announce: Callable[[Address], None] = lambda address: None,
) -> None:
    """Serve the workbench of a campaign on 127.0.0.1 until it is interrupted.

    Parameters
    ----------
    campaign : path
    output : path, optional
        The database, instead of the campaign's own.
    port : int
        0: any that is free.
    browse : bool
        Open the page in the browser.
    announce : callable
        Called with the address as soon as it listens.

    Raises
    ------
    Refused
        Where the campaign cannot be read, the pages were not built, or the port is taken.
    """
    from levkas.campaign.edits import sweep_corrections
    from levkas.pages.screen import read_built
    from levkas.workbench.library import Library

    _check_campaign(Path(campaign))
    library = Library(campaign, output)
    sweep_corrections(library.campaign.root)
    if not library.views:
        raise ServerRefused(
            Problem("E_NO_FRAMES", "the campaign has no layers to show", str(campaign))
        )
    library.list()
    for name in ("workbench.js", "workbench.css"):
        read_built(name)
    threading.Thread(target=_warm_up, args=(library,), daemon=True).start()
    listening = listen_on(port)
    address = Address(listening.getsockname()[1], token_urlsafe(TOKEN_BYTES))
    opening = OpeningPage(address)
    app = make_app(library, port=address.port, token=address.token, entered=opening.remove)
    server = server_of(app)
    announce(address)
    sys.stdout.flush()
    try:
        with _ending_alike(server):
            if browse:
                opening.show()
            server.run(sockets=[listening])
    except KeyboardInterrupt:
        pass
    finally:
        opening.remove()
        listening.close()


def server_of(app: App) -> uvicorn.Server:
    """Return the server of an application, which runs on a socket that listens."""
    import uvicorn

    config = uvicorn.Config(
        app, log_level="warning", access_log=False, ws="none", lifespan="off",
        server_header=False, date_header=False, timeout_graceful_shutdown=1,
    )  # fmt: skip
    return uvicorn.Server(config)


@contextlib.contextmanager
def _ending_alike(server: uvicorn.Server) -> Iterator[None]:
    """Let the ends that a terminal or a system gives to a process be like Ctrl-C: what is open is closed.

    uvicorn takes SIGINT and SIGTERM while it runs, SIGHUP not: an exception in the midst of its
    loop would leave threads behind that keep the process alive.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers: dict[int, Any] = {signal.SIGTERM: signal.default_int_handler}
    if hasattr(signal, "SIGHUP"):
        handlers[signal.SIGHUP] = server.handle_exit
    before = {one: signal.signal(one, handler) for one, handler in handlers.items()}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _check_campaign(folder: Path) -> None:
    """Refuse a database: corrections belong to its campaign."""
    from levkas.database.catalogue import NAME

    if (folder / NAME).is_file() and not (folder / "campaign.toml").is_file():
        raise ServerRefused(
            Problem(
                "E_UNREADABLE",
                "this is a database; registrations are corrected in its campaign",
                file=str(folder),
                expected="a folder with campaign.toml",
                fix="Give the folder of the campaign. To view a database, run levkas publish and open index.html.",
            )
        )


def _warm_up(library: Library) -> None:
    """Load what the first answer needs while the browser still starts."""
    from levkas.workbench.answer import describe

    for row in library.list():
        if not row["reference"]:
            with contextlib.suppress(Refused):
                frame = library.open(row["id"])
                with frame.lock:
                    describe(frame.session)
                return


class OpeningPage:
    """A page that leads a browser to the address, token included: all may read a command line.

    Only this user can read the file. It goes when the token has been handed in, and at the end in any case.

    Parameters
    ----------
    address : Address
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self.path: Path | None = None

    def show(self) -> None:
        """Write the page and open it in the browser."""
        import tempfile
        import webbrowser

        descriptor, name = tempfile.mkstemp(prefix="levkas-", suffix=".html")  # mode 0600
        self.path = Path(name)
        atexit.register(self.remove)
        with os.fdopen(descriptor, "w", encoding="utf-8") as page:
            page.write(f'<meta http-equiv="refresh" content="0; url={self.address.url}">')
        # A browser of the terminal holds the call until it ends; the server has to answer meanwhile.
        threading.Thread(target=webbrowser.open, args=[self.path.as_uri()], daemon=True).start()

    def remove(self) -> None:
        """Take the page away; nothing happens where it is gone, or where Windows still reads it."""
        if self.path is not None:
            with contextlib.suppress(OSError):
                self.path.unlink()


def listen_on(port: int) -> socket.socket:
    """Return a socket that listens on a port of this machine alone; raises ServerRefused where it is taken."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, port))
        listening.listen(128)  # whoever opens the address at once waits for the first answer
    except (OSError, OverflowError) as error:
        listening.close()
        raise ServerRefused(
            Problem(
                "E_PORT",
                f"port {port} cannot be used",
                field="--port",
                found=str(error),
                expected="a free port above 1023",
                fix="Omit --port to use any free port.",
            )
        ) from None
    return listening
