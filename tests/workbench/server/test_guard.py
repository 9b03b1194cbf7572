"""Every route, enumerated, refuses what is not its own page; no path leads out of the campaign."""

import asyncio
import base64
import json
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import unquote

import pytest
from starlette.applications import Starlette
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from levkas.workbench.answer import from_bytes
from levkas.workbench.library import Library, id_of
from levkas.workbench.server.app import make_app
from levkas.workbench.server.guard import LARGEST_IMPORT, OPEN, SAFE, Guard, cookie_of, largest_of

PORT, TOKEN = 4711, "k" * 43
OWN = f"http://127.0.0.1:{PORT}"
COOKIE = {"cookie": f"{cookie_of(PORT)}={TOKEN}"}
PARAMS = {"id": id_of("icon", "xray"), "name": "workbench.js", "which": "target", "kind": "ssim",
          "level": "0", "column": "0", "row": "0"}  # fmt: skip


@pytest.fixture(scope="module")
def app(correctable, tmp_path_factory):
    library = Library(correctable.make(tmp_path_factory.mktemp("web") / "campaign"))
    return make_app(library, port=PORT, token=TOKEN)


@pytest.fixture(scope="module")
def client(app):
    return TestClient(app, base_url=OWN)


def every_route(app):
    """(method, path) of all that is mounted; anything but a plain route fails."""
    found = []
    for route in app.app.routes:
        assert type(route) is Route, f"{route} is not enumerated by this test"
        path = route.path
        for name in route.param_convertors:
            for kind in ("", ":int", ":path"):
                path = path.replace("{" + name + kind + "}", PARAMS[name])
        assert "{" not in path
        found += [(method, path) for method in sorted(route.methods)]
    return found


def send(client, method, path, headers, body=b"{}"):
    given = {"content-type": "application/json"} if method not in SAFE else {}
    if method not in SAFE and not any(k in headers for k in ("origin", "sec-fetch-site")):
        given["origin"] = OWN
    data = body if method not in SAFE else None
    return client.request(method, path, headers={**given, **headers}, content=data)


def test_the_list_of_routes_is_long_enough_to_mean_something(app):
    paths = [path for _, path in every_route(app)]
    others = {path for path in OPEN if path.startswith("/assets/")}
    assert len(paths) >= 14 and {*paths, *others} >= OPEN


def test_no_route_is_mounted_in_a_way_that_is_not_enumerated():
    inner = Starlette(routes=[Mount("/files", app=Starlette())])
    with pytest.raises(AssertionError):
        every_route(Guard(inner, port=PORT, token=TOKEN))


@pytest.mark.parametrize(
    "host",
    ["evil.example", f"evil.example:{PORT}", "127.0.0.1", f"127.0.0.1:{PORT + 1}", "", f"[::1]:{PORT}",
     f"127.0.0.1:{PORT}.evil.example", f"localhost.evil.example:{PORT}", f"0.0.0.0:{PORT}"],
)  # fmt: skip
def test_every_route_refuses_a_foreign_host(app, client, host):
    for method, path in every_route(app):
        answer = send(client, method, path, {**COOKIE, "host": host})
        assert answer.status_code == 421, (method, path)


def test_two_hosts_are_not_one(client):
    headers = [("host", f"127.0.0.1:{PORT}"), ("host", "evil.example"), *COOKIE.items()]
    assert client.get("/api/cameras", headers=headers).status_code == 421


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://127.0.0.1:4711", "http://127.0.0.1:4712", ""]
)
def test_every_route_refuses_a_foreign_origin(app, client, origin):
    for method, path in every_route(app):
        answer = send(client, method, path, {**COOKIE, "origin": origin})
        assert answer.status_code == 403, (method, path)


@pytest.mark.parametrize("site", ["cross-site", "same-site", "anything"])
def test_every_route_refuses_requests_of_other_sites(app, client, site):
    for method, path in every_route(app):
        answer = send(client, method, path, {**COOKIE, "sec-fetch-site": site})
        assert answer.status_code == 403, (method, path)


def test_only_the_empty_page_may_be_reached_by_a_link_from_elsewhere(app, client):
    link = {**COOKIE, "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    let_in = {path for method, path in every_route(app)
              if method == "GET" and send(client, "GET", path, link).status_code == 200}  # fmt: skip
    assert let_in == {"/"}


@pytest.mark.parametrize(
    "cookie",
    [None, "", f"{cookie_of(PORT)}=", f"{cookie_of(PORT)}={'x' * 43}", f"levkas={TOKEN}",
     f"{cookie_of(PORT + 1)}={TOKEN}", f"{cookie_of(PORT)}={TOKEN[:-1]}", f"{cookie_of(PORT)}={TOKEN}k"],
)  # fmt: skip
def test_every_route_with_data_refuses_a_missing_or_wrong_token(app, client, cookie):
    headers = {} if cookie is None else {"cookie": cookie}
    refused = set()
    for method, path in every_route(app):
        answer = send(client, method, path, headers)
        if path in OPEN:
            continue
        assert answer.status_code == 401, (method, path)
        refused.add(path)
    assert len(refused) >= 11


def test_what_needs_no_token_says_nothing_of_the_campaign(client):
    page = client.get("/").text
    assert "icon" not in page.replace('rel="icon"', "") and "Plates" not in page
    for token in (None, "", "x", TOKEN[:-1]):
        answer = client.post("/enter", json={"token": token}, headers={"origin": OWN})
        assert answer.status_code == 401 and "set-cookie" not in answer.headers
    answer = client.post("/enter", json={"token": TOKEN}, headers={"origin": OWN})
    set_cookie = answer.headers["set-cookie"].lower()
    assert (
        answer.status_code == 200 and "httponly" in set_cookie and "samesite=strict" in set_cookie
    )
    client.cookies.clear()


def test_changing_requests_want_an_origin_and_json(app, client):
    for method, path in every_route(app):
        if method in SAFE:
            continue
        bare = client.request(method, path, headers=COOKIE, content=b"{}")
        assert bare.status_code == 403, path
        for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data"):
            headers = {**COOKIE, "origin": OWN, "content-type": kind}
            assert client.request(method, path, headers=headers).status_code == 415, path
        for body in (b"", b"[1]", b"{", b'{"value": NaN}', b"[" * 400):
            assert send(client, method, path, COOKIE, body).status_code == 422, path


@pytest.mark.parametrize("announced", [True, False])
def test_no_body_that_is_too_long_is_taken(app, client, announced):
    """Announced it is not read at all; in pieces it is read until it is too long."""
    for method, path in every_route(app):
        if method in SAFE:
            continue
        assert largest_of(path) <= (512 if path in OPEN else LARGEST_IMPORT)
        pieces = (b" " * 65536 for _ in range(largest_of(path) // 65536 + 3))
        headers = {**COOKIE, "origin": OWN, "content-type": "application/json"}
        if announced:
            headers["content-length"] = str(largest_of(path) + 1)
        answer = client.request(method, path, headers=headers, content=pieces)
        assert answer.status_code == 413, path
        assert answer.json()["problems"][0]["code"] == "E_NOT_ALLOWED"
    answer = client.post("/enter", headers={**headers, "content-length": "9" * 12}, content=b"{}")
    assert answer.status_code == 413


def nested(depth):
    return "[" * depth + "]" * depth


HOSTILE = [
    "null", '"\\ud800"', '{"\\udfff": 1}', nested(450), '{"token": NaN}', "9" * 400, '{"known": -Infinity}', "\x00",
    *(f'{{"{name}": {value}}}'
      for value in ("null", "true", "[]", "{}", '"\\ud800"', '"\\u0000"', "9" * 100, "-" + "9" * 400, "1e999", "-1e308",
                    "0.1", '"' + "x" * 300 + '"', '["\\ud800"]', "[[1, 2, 3, 4]]", f"[{'9' * 100}, 1, 1, 1]")
      for name in ("token", "operation", "pair", "dialect", "file", "known")),
    *(f'{{"operation": "{name}", "pair": {pair}, "to": {to}, "name": {what}, "value": {to}, "text": {to}, "target": "{band}"}}'
      for name in ("delete", "move", "snap", "slide", "undo")
      for pair, to, what, band in (("[1, 2, 3, 4]", "[1, 2]", "7", "999999"), ("[1e308, 2, 3, 4]", "9" * 9, "[]", "1,1"),
                                   ("[NaN, 2, 3, 4]", '"\\udc00"', '"stop"', "-1"), ("[1, 2, 3, 4]", "1e308", '"reject"', "١"))),
    *(f'{{"file": {file}, "dialect": {dialect}, "pair": [1, 2, 3, 4], "operation": "add", "to": [1e308, 1, 1, 1]}}'
      for file in ('"AAAA"', '"é"', '["AAAA"]') for dialect in ('"levkas"', '"nothing"', "[1]", "{}", "1e308")),
]  # fmt: skip
QUERIES = [
    "x=1&y=1&from=target&target=7", "x=1&y=1&reference=999999", "x=1&y=1&reference=1,2,9", "x=1e308&y=-1e308&reach=5",
    "x=1&y=1&reach=1e308", "x=1&y=1&reach=-5", "x=nan&y=inf", "x=%ED%A0%80&y=1", "bands=999999", "bands=1,1", "bands=" + "9" * 900,
    "map=%00&tint=%ED%A0%80", "x=1&y=1&map=trial&from=%F0", "%ED%A0%80=%FF", "reference=%D9%A1",
]  # fmt: skip


@pytest.mark.slow
def test_no_route_ends_in_a_fault_of_the_server_whatever_it_is_sent(app, client):
    """Every refusal has one shape; the client raises what a handler does not catch."""
    requested = 0
    for method, path in every_route(app):
        if path.endswith("/build"):  # they would begin one
            continue
        if method in SAFE:
            answers = [
                client.request(method, f"{path}?{query}", headers=COOKIE) for query in QUERIES
            ]
        else:
            answers = [send(client, method, path, COOKIE, body.encode()) for body in HOSTILE]
        for answer in answers:
            assert answer.status_code in (200, 401, 404, 409, 413, 422), (path, answer.text[:200])
            if answer.status_code != 200 and method != "HEAD":
                record = answer.json()
                assert record["ok"] is False and record["problems"][0]["code"].startswith("E_"), (
                    path
                )
        requested += len(answers)
    assert requested > 500
    client.cookies.clear()


@pytest.mark.parametrize("number", ["9" * 10, "9" * 100, "9" * 5000, "-1", "1e3", "%D9%A1", "nan"])
def test_numbers_in_an_address_that_are_none_are_answered_404(client, number):
    for place in (f"{number}/0/0", f"0/{number}/0", f"0/0/{number}"):
        answer = client.get(f"/api/cameras/{PARAMS['id']}/tiles/target/{place}", headers=COOKIE)
        assert answer.status_code == 404 and answer.json()["problems"]


@pytest.mark.parametrize("query", ["x=100&y=100&target=7", "x=100&y=100&reference=3"])
def test_a_band_that_is_not_there_is_refused_by_its_number(client, query):
    answer = client.get(f"/api/cameras/{PARAMS['id']}/partner?{query}", headers=COOKIE)
    (problem,) = answer.json()["problems"]
    assert (
        answer.status_code == 422
        and problem["found"] in ("7", "3")
        and "band" in problem["message"]
    )


def test_other_methods_are_refused(app, client):
    for method in ("PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"):
        for _, path in every_route(app):
            answer = send(client, method, path, COOKIE)
            assert answer.status_code in (404, 405, 403), (method, path)
            assert not any(h.lower().startswith("access-control") for h in answer.headers)


def test_every_answer_carries_the_headers_that_keep_other_pages_out(app, client):
    for headers in (COOKIE, {}):
        for method, path in every_route(app):
            answer = send(client, method, path, headers)
            policy = answer.headers["content-security-policy"]
            assert "default-src 'none'" in policy and "unsafe" not in policy and "*" not in policy
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert answer.headers["cross-origin-resource-policy"] == "same-origin"
            assert answer.headers["cross-origin-opener-policy"] == "same-origin"


@pytest.mark.parametrize(
    "headers",
    [
        {**COOKIE, "host": "evil.example", "origin": OWN},
        {**COOKIE, "origin": "http://evil.example"},
        {**COOKIE, "sec-fetch-site": "cross-site", "origin": OWN},
        dict(COOKIE),
        {"origin": OWN},
        {"origin": OWN, "cookie": f"{cookie_of(PORT)}=wrong"},
    ],
    ids=["host", "origin", "site", "no origin", "no token", "wrong token"],
)
def test_websockets_are_refused_alike(headers):
    async def echo(socket):
        await socket.accept()
        await socket.send_text("secret")
        await socket.close()

    inner = Starlette(routes=[WebSocketRoute("/api/live", echo)])
    client = TestClient(Guard(inner, port=PORT, token=TOKEN), base_url=OWN)
    own = {"host": f"127.0.0.1:{PORT}"}
    good = {**COOKIE, **own, "origin": OWN}
    with client.websocket_connect("/api/live", headers=good) as socket:
        assert socket.receive_text() == "secret"
    with (
        pytest.raises((WebSocketDisconnect, WebSocketDenialResponse)),
        client.websocket_connect("/api/live", headers={**own, **headers}) as socket,
    ):
        socket.receive_text()


CLIMBS = ["..", "../..", "..%2f..", "%2e%2e/%2e%2e", "....//", "..\\..", "%2e%2e%5c", "/etc/passwd",
          "%2fetc%2fpasswd", "C:%5cwindows", "icon1%00.tif", "%c0%ae%c0%ae", "icon/../../campaign.toml"]  # fmt: skip


def ask_raw(app, path):
    """Ask for a path as it stands: clients tidy paths before they send them."""
    sent = []
    headers = [(k.encode(), v.encode()) for k, v in {**COOKIE, "host": f"127.0.0.1:{PORT}"}.items()]
    scope = {"type": "http", "http_version": "1.1", "method": "GET", "scheme": "http", "query_string": b"",
             "path": unquote(path), "raw_path": path.encode(), "root_path": "", "headers": headers}  # fmt: skip

    async def receive():
        return {"type": "http.request", "body": b""}

    async def send(message):
        sent.append(message)

    # In a thread of its own: a browser of other tests may have a loop running in this one.
    with ThreadPoolExecutor(1) as beside:
        beside.submit(asyncio.run, app(scope, receive, send)).result()
    return sent[0]["status"], b"".join(m.get("body", b"") for m in sent)


@pytest.mark.parametrize("climb", CLIMBS)
def test_no_path_climbs_out(climb, app):
    shapes = [f"/{climb}", f"/assets/{climb}", f"/api/cameras/{climb}", f"/api/cameras/{climb}/pairs",
              f"/api/cameras/{PARAMS['id']}/tiles/{climb}/0/0/0", f"/api/cameras/{PARAMS['id']}/maps/{climb}",
              f"/api/cameras/{PARAMS['id']}/tiles/target/{climb}/0/0"]  # fmt: skip
    for shape in shapes:
        status, content = ask_raw(app, shape)
        assert status == 404, shape
        assert b"root:" not in content and b"[campaign]" not in content


def test_a_link_to_elsewhere_in_the_place_of_a_page_is_not_served(client, tmp_path):
    """Assets come from a table of two names, so that no link in a folder is ever followed."""
    secret = tmp_path / "secret"
    secret.write_text("secret")
    (tmp_path / "workbench.map").symlink_to(secret)
    for name in ("workbench.map", "secret", str(secret).strip("/")):
        assert client.get(f"/assets/{name}", headers=COOKIE).status_code == 404


def test_a_record_that_leads_elsewhere_is_not_followed(correctable, tmp_path):
    """Names of files are made from the campaign's own captures; what a record says opens nothing."""
    folder = correctable.make(tmp_path / "campaign")
    path = folder / "database/objects/icon/registration/xray.json"
    record = json.loads(path.read_text())
    record["target"]["band"] = "../../../../etc/passwd"
    path.write_text(json.dumps(record))
    library = Library(folder)
    client = TestClient(make_app(library, port=PORT, token=TOKEN), base_url=OWN)
    answer = client.get(f"/api/cameras/{PARAMS['id']}", headers=COOKIE)
    assert answer.status_code == 200 and answer.json()["band"] == "grey"


def test_hostile_bodies_change_nothing_and_are_told_why(client, correctable):
    before = client.get(f"/api/cameras/{PARAMS['id']}/pairs", headers=COOKIE).content
    hostile = [
        {"operation": "__class__", "pair": [1, 2, 3, 4]},
        {"operation": "delete", "pair": ["a", 2, 3, 4]},
        {"operation": "delete", "pair": [True, 2, 3, 4]},
        {"operation": "add", "pair": [1e300, 2, 3, 4]},
        {"operation": "slide", "name": "deleted", "value": 3},
        {"operation": "slide", "name": "stop", "value": "1e999"},
        {"operation": "move", "pair": [1, 2, 3, 4], "to": [1]},
        {"operation": {}, "pair": {}},
        {"operation": "outline"},
        {"operation": "outline", "corners": "all"},
        {"operation": "outline", "corners": [[1, 2], [3, 4], [5]]},
        {"operation": "outline", "corners": [[1, 2], [3, 4], ["5", True]]},
        {"operation": "outline", "corners": [[1, 2], [1e300, 4], [5, 9]]},
        {"operation": "outline", "corners": [[0, 0], [9, 9], [9, 0], [0, 9]]},
        {"operation": "outline", "corners": [[0, 0]] * 100_000},
    ]
    for body in hostile:
        answer = send(
            client, "POST", f"/api/cameras/{PARAMS['id']}/edit", COOKIE, json.dumps(body).encode()
        )
        assert answer.status_code == 422 and answer.json()["problems"], body
    for file in ([], "x", "%%%", base64.b64encode(b"\x89PNG").decode(), None):
        body = json.dumps({"file": file}).encode()
        assert (
            send(client, "POST", f"/api/cameras/{PARAMS['id']}/import", COOKIE, body).status_code
            == 422
        )
    after = client.get(f"/api/cameras/{PARAMS['id']}/pairs", headers=COOKIE).content
    assert after == before


def test_an_edit_over_http_is_an_edit(client, app):
    where = f"/api/cameras/{PARAMS['id']}"
    record = from_bytes(client.get(f"{where}/pairs", headers=COOKIE).content)
    before = record["summary"]["kept"]
    pair = record["pairs"][5]
    body = json.dumps({"operation": "delete", "pair": pair.tolist()}).encode()
    after = from_bytes(send(client, "POST", f"{where}/edit", COOKIE, body).content)
    assert after["summary"]["kept"] == before - 1
    assert after["can"]["undo"] == record["can"]["undo"] + 1
    body = b'{"operation": "undo"}'
    undone = from_bytes(send(client, "POST", f"{where}/edit", COOKIE, body).content)
    assert undone["summary"]["kept"] == before
    assert undone["corrections"] == record["corrections"]
