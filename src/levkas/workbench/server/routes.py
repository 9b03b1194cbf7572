"""Routes of the workbench: each reads, calls the library once and shapes the answer; rebuilding."""

from __future__ import annotations

import base64
import binascii
import json
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import wraps
from secrets import compare_digest
from typing import TYPE_CHECKING, Any

import numpy as np
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from levkas.campaign.edits import EditsConflict
from levkas.campaign.schema.values import MOST_CORNERS
from levkas.core.locks import Taken
from levkas.core.problems import Problem, Refused
from levkas.database.registrations import object_outline, unchecked_share
from levkas.pages.page import describe_decision
from levkas.pages.screen import read_built
from levkas.registration.advice import in_workbench
from levkas.registration.record import decided
from levkas.workbench.answer import describe
from levkas.workbench.frame import SIDES, RegistrationView, SensorView
from levkas.workbench.library import FrameMissing, Library
from levkas.workbench.session import OperationRefused, refused

if TYPE_CHECKING:
    from levkas.workbench.library import Library


class Busy(Refused):
    """Another build runs."""


@dataclass
class Rebuild:
    """The build that runs, or the last one that ran.

    Parameters
    ----------
    library : Library
    """

    library: Library
    state: str = "idle"
    line: str = ""
    problems: list[dict[str, Any]] = field(default_factory=list)
    done: int = 0
    total: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self, key: str) -> None:
        """Build the object of a camera.

        Raises
        ------
        Busy
            While another build runs.
        FrameMissing
            Where there is no such camera.
        """
        frame = self.library.open(key)
        with self._lock:
            if self.state == "running":
                raise Busy(Problem("E_BUSY", "a build is running", found=self.line))
            self.state, self.line, self.problems = "running", "starting", []
        name = frame.capture.object
        threading.Thread(target=self._run, args=(key, name), daemon=True).start()

    def _run(self, key: str, name: str) -> None:
        from levkas.building import build, summarise

        steps = []
        try:
            library = self.library
            for step in build(library.path, output=library.output, objects=[name]):
                steps.append(step)
                self.line, self.done, self.total = step.label, step.done, step.total
            report = summarise(steps)
            self.problems = [p.to_dict() for p in report.problems]
            library.reopen(key)
            self.state = "done"
        except Refused as refused:
            self.problems = [p.to_dict() for p in refused.problems]
            self.state = "failed"
        except Exception as error:
            # A thread that dies in silence would leave the screen waiting for ever.
            self.problems = [Problem("E_FAILED", f"the build failed: {error}").to_dict()]
            self.state = "failed"
            raise

    def to_dict(self) -> dict[str, Any]:
        """Return what the screen shows, JSON-ready."""
        return {
            "state": self.state,
            "line": self.line,
            "done": self.done,
            "total": self.total,
            "problems": self.problems,
        }


STATUS: dict[type[Refused], int] = {
    FrameMissing: 404,
    Busy: 409,
    EditsConflict: 409,
    Taken: 409,
}

ASSETS = {"workbench.js": "text/javascript", "workbench.css": "text/css"}

MOST_BANDS = 3

QUARTERS = (0, 90, 180, 270)
LONGEST_NUMBER = 9
"""Digits of a whole number in an address or a request."""

FARTHEST_PX = 1000.0
"""How far from where a map puts it a partner is looked for at most."""

Answer = Callable[[Request, dict[str, Any]], Response]


def answering(handler: Callable[..., Response]) -> Callable[[Request], Any]:
    """Give a handler the body, read as JSON, run it in a thread, and turn refusals into answers."""

    @wraps(handler)
    async def answer(request: Request) -> Response:
        from starlette.concurrency import run_in_threadpool

        try:
            body = await _body(request) if request.method == "POST" else {}
            return await run_in_threadpool(handler, request, body)
        except Refused as refusal:
            status = next((s for kind, s in STATUS.items() if isinstance(refusal, kind)), 422)
            record: dict[str, Any] = {"problems": [p.to_dict() for p in refusal.problems]}
            if isinstance(refusal, EditsConflict):
                present = refusal.present
                record["present"] = list(present) if isinstance(present, tuple) else asdict(present)
            return JSONResponse({"ok": False, **record}, status)

    return answer


async def _body(request: Request) -> dict[str, Any]:
    try:
        record = json.loads(
            await request.body(), parse_constant=_no_constant, parse_int=_whole_number
        )
        json.dumps(record, ensure_ascii=False).encode()  # half a character is none
    except (ValueError, RecursionError):
        raise refused("the request is not JSON", "", "a JSON object") from None
    if not isinstance(record, dict):
        raise refused("the request is not JSON object", type(record).__name__, "an object")
    return record


def _no_constant(name: str) -> float:
    raise ValueError(name)


def _whole_number(text: str) -> int:
    if len(text) > LONGEST_NUMBER:
        raise ValueError(text[:LONGEST_NUMBER])
    return int(text)


def enter(body: dict[str, Any], token: str, cookie: str, entered: Callable[[], object]) -> Response:
    """Let a browser in that hands in the token: from then on a cookie carries it."""
    if not compare_digest(str(body.get("token", "")).encode(), token.encode()):
        problem = {"code": "E_NOT_ALLOWED", "message": "the token is wrong"}
        return JSONResponse({"ok": False, "problems": [problem]}, 401)
    response = JSONResponse({"ok": True})
    entered()
    response.set_cookie(cookie, token, httponly=True, samesite="strict", path="/")
    return response


def asset(request: Request, assets: dict[str, str]) -> Response:
    """Return a built file that is one of a page's; raises FrameMissing for others."""
    name = request.path_params["name"]
    if name not in assets:
        raise FrameMissing(Problem("E_NO_FILE", "there is no such file"))
    return Response(read_built(name), media_type=assets[name])


async def refuse_http(request: Request, error: Exception) -> Response:
    """Answer for a path or a method that there is not, as every refusal is answered."""
    status = getattr(error, "status_code", 404)
    problem = Problem(
        "E_NO_PAGE", "no such page", found=f"{request.method} {request.url.path[:80]}"
    )
    return JSONResponse(
        {"ok": False, "problems": [problem.to_dict()]}, status, getattr(error, "headers", None)
    )


@dataclass(frozen=True)
class Handlers:
    """One method a route: request and body in, response out.

    Parameters
    ----------
    library : Library
    token, cookie : str
        What a browser hands in, and the name of the cookie that carries it from then on.
    entered : callable
        Called whenever a browser has handed in the token.
    rebuild : Rebuild
    """

    library: Library
    token: str
    cookie: str
    entered: Callable[[], object]
    rebuild: Rebuild

    def _frame(self, request: Request) -> RegistrationView:
        return self.library.open(request.path_params["id"])

    def page(self, request: Request, body: dict[str, Any]) -> Response:
        return HTMLResponse(PAGE)

    def asset(self, request: Request, body: dict[str, Any]) -> Response:
        return asset(request, ASSETS)

    def enter(self, request: Request, body: dict[str, Any]) -> Response:
        return enter(body, self.token, self.cookie, self.entered)

    def cameras(self, request: Request, body: dict[str, Any]) -> Response:
        title = self.library.campaign.campaign.title
        return JSONResponse({"ok": True, "campaign": title, "cameras": self.library.list()})

    def camera(self, request: Request, body: dict[str, Any]) -> Response:
        frame = self._frame(request)
        more = {
            "turn": self.library.turn_of(frame),
            "declared_outline": self.library.declared_outline(frame),
            "beside": self.library.neighbours(frame.view),
            **self.library.registered_with(frame),
        }
        self.library.judge(frame)
        return JSONResponse({"ok": True, **describe_frame(frame), **more})

    def confirm(self, request: Request, body: dict[str, Any]) -> Response:
        name, words, map_ = (str(body.get(key, "")).strip() for key in ("name", "words", "map"))
        given = None if body.get("take_back") is True else name
        self.library.confirm(self._frame(request), given, words, map_)
        return JSONResponse({"ok": True})

    def turn(self, request: Request, body: dict[str, Any]) -> Response:
        frame, degrees = self._frame(request), body.get("degrees")
        if degrees not in QUARTERS or isinstance(degrees, bool):
            raise refused("pictures are turned by quarters", str(degrees)[:40], "0, 90, 180 or 270")
        self.library.turns[frame.capture.object] = int(degrees)
        return JSONResponse({"ok": True, "turn": degrees})

    def pairs(self, request: Request, body: dict[str, Any]) -> Response:
        frame = self._frame(request)
        with frame.lock:
            self.library.catch_up(frame)
            return _answer(describe(frame.session))

    def edit(self, request: Request, body: dict[str, Any]) -> Response:
        frame = self._frame(request)
        with frame.lock:
            change(frame, body)
            return _answer(describe(frame.session))

    def partner(self, request: Request, body: dict[str, Any]) -> Response:
        with (frame := self._frame(request)).lock:
            return JSONResponse({"ok": True, **frame.partner(**_partner_query(request))})

    def tile(self, request: Request, body: dict[str, Any]) -> Response:
        which = request.path_params["which"]
        level, column, row = (_digits(request.path_params[k]) for k in ("level", "column", "row"))
        query = request.query_params
        bands = _bands(query.get("bands", ""))
        try:
            place, map_ = (level, column, row), query.get("map", "")
            data, kind = self._frame(request).tile(which, place, bands=bands, map_=map_)
        except IndexError:
            raise FrameMissing(Problem("E_NO_TILE", "there is no such tile")) from None
        return Response(data, media_type=kind, headers={"cache-control": "private, max-age=900"})

    def export(self, request: Request, body: dict[str, Any]) -> Response:
        frame = self._frame(request)
        name, data = frame.export()
        text = base64.b64encode(data).decode("ascii")
        return JSONResponse({"ok": True, "name": name, "data": text})

    def import_(self, request: Request, body: dict[str, Any]) -> Response:
        frame = self._frame(request)
        with frame.lock:
            counts = frame.take(_file(body.get("file")))
            return _answer({**counts, **describe(frame.session)})

    def start_build(self, request: Request, body: dict[str, Any]) -> Response:
        self.rebuild.start(request.path_params["id"])
        return JSONResponse({"ok": True, **self.rebuild.to_dict()})

    def build_state(self, request: Request, body: dict[str, Any]) -> Response:
        return JSONResponse({"ok": True, **self.rebuild.to_dict()})


def routes(
    library: Library, *, token: str, cookie: str, entered: Callable[[], object] = lambda: None
) -> list[Route]:
    """Return every route; each but those of `guard.OPEN` is behind the token, which `cookie` carries."""
    handlers = Handlers(library, token, cookie, entered, Rebuild(library))
    one = "/api/cameras/{id}"
    table: list[tuple[str, Callable[..., Response], str]] = [
        ("/", handlers.page, "GET"),
        ("/assets/{name}", handlers.asset, "GET"),
        ("/enter", handlers.enter, "POST"),
        ("/api/cameras", handlers.cameras, "GET"),
        (one, handlers.camera, "GET"),
        (f"{one}/pairs", handlers.pairs, "GET"),
        (f"{one}/edit", handlers.edit, "POST"),
        (f"{one}/turn", handlers.turn, "POST"),
        (f"{one}/confirm", handlers.confirm, "POST"),
        (f"{one}/partner", handlers.partner, "GET"),
        (one + "/tiles/{which}/{level}/{column}/{row}", handlers.tile, "GET"),
        (f"{one}/export", handlers.export, "POST"),
        (f"{one}/import", handlers.import_, "POST"),
        (f"{one}/build", handlers.start_build, "POST"),
        ("/api/build", handlers.build_state, "GET"),
    ]
    return [Route(path, answering(handler), methods=[method]) for path, handler, method in table]


def _answer(answer: dict[str, Any]) -> Response:
    return JSONResponse({"ok": True, **answer})


def change(frame: RegistrationView, body: dict[str, Any]) -> None:
    """Apply a request to the corrections of a camera.

    Raises
    ------
    OperationRefused
    """
    session, name = frame.session, str(body.get("operation", ""))
    if name in ("undo", "redo", "take_all_back"):
        getattr(session, name)()
    elif name == "outline":
        session.draw(_corners(body.get("corners")))
    elif name == "accept":
        session.accept(body.get("value") is True)
    elif name == "snap":
        bands = {side: _bands(str(body.get(side, ""))) for side in SIDES}
        frame.snap(_pair(body.get("pair")), bands)
    else:
        to = _pair(body["to"]) if body.get("to") is not None else None
        session.apply(name, _pair(body.get("pair")), to)


def describe_frame(frame: RegistrationView) -> dict[str, Any]:
    """Return what a screen needs to know of a camera before its pairs, JSON-ready."""
    verdict = frame.record.get("verdict", {})
    model = frame.record.get("model", {})
    outline = object_outline(frame.record)
    if not len(outline):  # of a refused camera the record does not say: that of the reference does
        outline = object_outline(frame.main_record)
    found = frame.session.found
    judged = {k: verdict.get(k) for k in ("decision", "reasons", "next_step", "layer", "map")}
    judged["words"] = describe_decision(decided(verdict), unchecked_share(frame.record))
    judged["next_step"] = in_workbench(judged["next_step"] or "")
    judged["reasons"] = reasons_of(frame, judged["reasons"] or [])
    sensors = [s for s in model.get("sensors", []) if isinstance(s, dict)]
    sensors = [s for s in sensors if s.get("sensor") == frame.view.sensor.name] or sensors
    return {
        "id": frame.key,
        "object": frame.capture.object,
        "camera": frame.capture.frame,
        "sensor": frame.view.sensor.name if len(frame.capture.sensors) > 1 else "",
        "band": frame.band,
        "bands": _describe_bands(frame.view),
        "reference": {
            "camera": frame.reference.frame,
            "band": frame.reference_band,
            "bands": _describe_bands(frame.main),
        },
        "is_reference": frame.view == frame.main,
        "size": list(found.size),
        "target_size": list(found.target_size),
        "px_per_mm": frame.px_per_mm,
        "built": frame.built is not None,
        "builds": frame.builds,
        "verdict": judged,
        "scores": [s.get("scores", {}) for s in sensors[:1]],
        "chosen": [s.get("base", "") for s in sensors[:1]],
        "basis": basis_of(frame),
        "outline": outline.tolist(),
    }


def basis_of(frame: RegistrationView) -> dict[str, Any] | None:
    """Return the windows on which the map of a sensor rests, as the record holds them; None of other methods."""
    trace = frame.record.get("trace", {})
    sensors = trace.get("sensors", []) if trace.get("kind") == "windows" else []
    name = frame.view.sensor.name
    return next((s for s in sensors if s.get("sensor") == name and "windows" in s), None)


def reasons_of(frame: RegistrationView, reasons: list[str]) -> list[str]:
    """Return the reasons of a verdict but for those about other sensors of the camera."""
    names = [f"sensor {s.name}: " for s in frame.capture.sensors if s.name]
    mine = f"sensor {frame.view.sensor.name}: "
    others = tuple(name for name in names if name != mine)
    kept = [r.removeprefix(mine) for r in reasons if not others or not r.startswith(others)]
    return [r[:1].upper() + r[1:] for r in kept] or reasons


def _describe_bands(view: SensorView) -> list[dict[str, Any]]:
    """Labels and wavelengths of a sensor's bands."""
    return [
        {"label": b.label, "wavelength": b.wavelength if np.isfinite(b.wavelength) else None}
        for b in view.sensor.bands
    ]


def _partner_query(request: Request) -> dict[str, Any]:
    query = request.query_params
    return {
        "x": _number(query.get("x")),
        "y": _number(query.get("y")),
        "side": "target" if query.get("from") == "target" else "reference",
        "which": query.get("map", ""),
        "reach": None if query.get("reach") is None else _reach(query.get("reach")),
        "bands": {side: _bands(query.get(side, "")) for side in SIDES},
    }


def _bands(text: str) -> tuple[int, ...]:
    """Numbers of bands, separated by commas."""
    parts = text.split(",") if text else []
    if len(parts) > MOST_BANDS or not all(part.isascii() and part.isdigit() for part in parts):
        raise refused("bands are numbers", text[:40], "none, one, or three separated by commas")
    return tuple(int(part[:LONGEST_NUMBER]) for part in parts)


def _number(value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number) or isinstance(value, bool):
        raise refused("a number is missing", str(value)[:40], "a finite number")
    return number


def _digits(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or len(text) > LONGEST_NUMBER:
        raise FrameMissing(Problem("E_NO_TILE", "there is no such tile", found=text[:40]))
    return int(text)


def _reach(value: Any) -> float:
    reach = _number(value)
    if not 0 < reach <= FARTHEST_PX:
        raise refused("no partner is looked for so far", reach, f"up to {FARTHEST_PX:g} px")
    return reach


def _pair(value: Any) -> list[float]:
    if not isinstance(value, list) or len(value) != 4:
        raise refused("a pair is four numbers", str(value)[:60], "[x, y, x, y]")
    return [_number(v) for v in value]


def _corners(value: Any) -> tuple[tuple[float, float], ...]:
    if not isinstance(value, list) or len(value) > MOST_CORNERS:
        raise refused("an outline is a list of corners", str(value)[:60], "[[x, y], …]")
    if not all(isinstance(corner, list) and len(corner) == 2 for corner in value):
        raise refused("a corner is two numbers", str(value)[:60], "[x, y]")
    return tuple((_number(x), _number(y)) for x, y in value)


def _file(value: Any) -> bytes:
    try:
        return base64.b64decode(str(value or ""), validate=True)
    except (binascii.Error, ValueError) as error:
        raise OperationRefused(
            Problem("E_VALUE", "no file came", expected="a file, base64")
        ) from error


def page_of(title: str, name: str) -> str:
    """Return the document of a page that its script fills."""
    return f"""\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="robots" content="noindex">
<title>{title}</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="/assets/{name}.css">
<script src="/assets/{name}.js" defer></script>
</head>
<body>
<noscript>This page needs JavaScript; nothing is loaded from anywhere else.</noscript>
</body>
</html>
"""


PAGE = page_of("Levkas workbench", "workbench")
