"""Every route, enumerated, refuses what is not its own page; no path leads out of the campaign."""

import asyncio
import base64
import json
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import unquote

import pytest
from starlette.routing import Route
from starlette.testclient import TestClient

from levkas.workbench.library import Library, id_of
from levkas.workbench.server.app import make_app
from levkas.workbench.server.guard import LARGEST_IMPORT, OPEN, SAFE, cookie_of, largest_of

PORT, TOKEN = 4711, "k" * 43
OWN = f"http://127.0.0.1:{PORT}"
COOKIE = {"cookie": f"{cookie_of(PORT)}={TOKEN}"}
PARAMS = {"id": id_of("icon", "xray"), "name": "workbench.js", "which": "target",
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


FOREIGN = [
    *(({"host": host}, 421) for host in ("evil.example", f"127.0.0.1:{PORT + 1}", "", f"127.0.0.1:{PORT}.evil.example")),
    *(({"origin": origin}, 403) for origin in ("http://evil.example", "null", f"https://127.0.0.1:{PORT}", "")),
    *(({"sec-fetch-site": site}, 403) for site in ("cross-site", "same-site")),
]  # fmt: skip


@pytest.mark.parametrize(("headers", "status"), FOREIGN)
def test_every_route_refuses_what_is_of_another_host_origin_or_site(app, client, headers, status):
    for method, path in every_route(app):
        answer = send(client, method, path, {**COOKIE, **headers})
        assert answer.status_code == status, (method, path)


def test_two_hosts_are_not_one(client):
    headers = [("host", f"127.0.0.1:{PORT}"), ("host", "evil.example"), *COOKIE.items()]
    assert client.get("/api/cameras", headers=headers).status_code == 421


def test_only_the_empty_page_may_be_reached_by_a_link_from_elsewhere(app, client):
    link = {**COOKIE, "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    let_in = {path for method, path in every_route(app)
              if method == "GET" and send(client, "GET", path, link).status_code == 200}  # fmt: skip
    assert let_in == {"/"}


@pytest.mark.parametrize(
    "cookie",
    [
        None,
        f"{cookie_of(PORT)}=",
        f"levkas={TOKEN}",
        f"{cookie_of(PORT + 1)}={TOKEN}",
        f"{cookie_of(PORT)}={TOKEN}k",
    ],
)
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


HOSTILE = [
    "null", '"\\ud800"', '{"\\udfff": 1}', "[" * 450 + "]" * 450, '{"token": NaN}', "9" * 400, "\x00",
    *(f'{{"{name}": {value}}}' for value in ("null", "[]", '"\\u0000"', "-" + "9" * 400, "1e999", "[[1, 2, 3, 4]]")
      for name in ("token", "operation", "pair", "file")),
    *(f'{{"operation": "{name}", "pair": {pair}, "to": {to}, "target": "{band}"}}' for name in ("move", "snap", "undo")
      for pair, to, band in (("[1, 2, 3, 4]", "[1, 2]", "999999"), ("[1e308, 2, 3, 4]", "9" * 9, "1,1"), ("[1]", "1e308", "١"))),
]  # fmt: skip
QUERIES = [
    "x=1&y=1&from=target&target=7", "x=1&y=1&reference=1,2,9", "x=1e308&y=-1e308&reach=5", "x=1&y=1&reach=-5",
    "x=nan&y=inf", "x=%ED%A0%80&y=1", "bands=" + "9" * 900, "map=%00", "%ED%A0%80=%FF", "reference=%D9%A1",
]  # fmt: skip


@pytest.mark.slow
def test_no_route_ends_in_a_fault_of_the_server_whatever_it_is_sent(app, client):
    """Every refusal has one shape; the client raises what a handler does not catch."""
    for method, path in every_route(app):
        if path.endswith("/build"):  # they would begin one
            continue
        if method in SAFE:
            answers = [client.request(method, f"{path}?{q}", headers=COOKIE) for q in QUERIES]
        else:
            answers = [send(client, method, path, COOKIE, body.encode()) for body in HOSTILE]
        for answer in answers:
            assert answer.status_code in (200, 401, 404, 409, 413, 422), (path, answer.text[:200])
            if answer.status_code != 200 and method != "HEAD":
                assert answer.json()["problems"][0]["code"].startswith("E_"), path
    client.cookies.clear()


@pytest.mark.parametrize("number", ["9" * 5000, "-1", "1e3", "%D9%A1"])
def test_numbers_in_an_address_that_are_none_are_answered_404(client, number):
    for place in (f"{number}/0/0", f"0/{number}/0", f"0/0/{number}"):
        answer = client.get(f"/api/cameras/{PARAMS['id']}/tiles/target/{place}", headers=COOKIE)
        assert answer.status_code == 404 and answer.json()["problems"]


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


def test_no_websocket_passes(app):
    sent = []

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": "websocket.connect"}

    scope = {"type": "websocket", "path": "/api/cameras", "headers": []}
    with ThreadPoolExecutor(1) as beside:
        beside.submit(asyncio.run, app(scope, receive, send)).result()
    assert [message["type"] for message in sent] == ["websocket.close"]


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
              f"/api/cameras/{PARAMS['id']}/tiles/{climb}/0/0/0",
              f"/api/cameras/{PARAMS['id']}/tiles/target/{climb}/0/0"]  # fmt: skip
    for shape in shapes:
        status, content = ask_raw(app, shape)
        assert status == 404, shape
        assert b"root:" not in content and b"[campaign]" not in content


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


def test_an_edit_over_http_is_an_edit_and_one_that_contradicts_is_refused(correctable, tmp_path):
    where = f"/api/cameras/{PARAMS['id']}"
    folder = correctable.make(tmp_path / "campaign")
    apps = [make_app(Library(folder), port=PORT, token=TOKEN) for _ in range(2)]
    one, other = (TestClient(app, base_url=OWN) for app in apps)

    def edit(client, **body):
        return send(client, "POST", f"{where}/edit", COOKIE, json.dumps(body).encode())

    record = one.get(f"{where}/pairs", headers=COOKIE).json()
    other.get(f"{where}/pairs", headers=COOKIE)
    pair = record["pairs"][5]
    after = edit(one, operation="delete", pair=pair).json()
    assert after["summary"]["kept"] == record["summary"]["kept"] - 1
    assert after["can"]["undo"] == 1
    there = (folder / "edits.toml").read_bytes()
    refused = edit(other, operation="pin", pair=pair)
    assert refused.status_code == 409 and refused.json()["problems"][0]["code"] == "E_CONFLICT"
    assert (folder / "edits.toml").read_bytes() == there
    shown = other.get(f"{where}/pairs", headers=COOKIE).json()
    assert shown["corrections"] == after["corrections"]
    assert edit(other, operation="restore", pair=pair).status_code == 200
    one.get(f"{where}/pairs", headers=COOKIE)
    (folder / "edits.toml").write_text("version = 1\n[objects\n")
    spoilt = edit(one, operation="pin", pair=pair)
    assert spoilt.status_code == 422 and (folder / "edits.toml").read_text().endswith("[objects\n")
