"""`levkas inspect` as a person starts and ends it."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from levkas.pages.screen import ScreenMissing, read_built

COMMAND = [sys.executable, "-c", "from levkas.cli import main; main()", "inspect"]


@pytest.fixture(scope="module")
def campaign(correctable, tmp_path_factory):
    try:
        read_built("workbench.js")
    except ScreenMissing:
        pytest.skip("the front-end is not built: run `make frontend`")
    return correctable.make(tmp_path_factory.mktemp("inspect") / "campaign")


def send(address, path, *, cookie="", body=None):
    headers = {"Origin": address} if body is not None else {}
    headers |= {"Cookie": cookie} if cookie else {}
    data = None
    if body is not None:
        headers["Content-Type"], data = "application/json", json.dumps(body).encode()
    return urllib.request.urlopen(
        urllib.request.Request(address + path, data, headers), timeout=600
    )


@pytest.mark.skipif(os.name == "nt", reason="signals of Unix")
def test_it_says_its_address_serves_this_machine_alone_and_ends_cleanly(campaign):
    run = subprocess.Popen(
        [*COMMAND, str(campaign), "--no-open"], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, "PYTHONUTF8": "1"},
    )  # fmt: skip
    try:
        # Both lines by the same reader: `communicate` does not see what it has read ahead.
        line, second = run.stdout.readline(), run.stdout.readline()
        found = re.search(r"(http://127\.0\.0\.1:(\d+))/#([\w-]{43})$", line.strip())
        assert found, line
        address, port, token = found.groups()
        assert b"workbench.js" in send(address, "/").read()
        with pytest.raises(urllib.error.HTTPError) as refused:
            send(address, "/api/cameras")
        assert refused.value.code == 401
        cookie = send(address, "/enter", body={"token": token}).headers["Set-Cookie"].split(";")[0]
        record = json.load(send(address, "/api/cameras", cookie=cookie))
        assert {row["camera"] for row in record["cameras"]} == {"photo", "xray"}
        # Through ssh -L the browser asks localhost by the same port.
        request = urllib.request.Request(f"{address}/", headers={"Host": f"localhost:{port}"})
        assert urllib.request.urlopen(request, timeout=600).status == 200
        with pytest.raises(OSError):
            socket.create_connection((_other_address(), int(port)), timeout=2)
        run.send_signal(signal.SIGINT)
        said, errors = run.communicate(timeout=600)
    finally:
        run.kill()
    assert run.returncode == 0 and errors == ""
    assert "ssh -L" in second and said.rstrip().endswith("`levkas build` applies them.")


def _other_address():
    """An address of this machine that is not the loopback's; the loopback's second where it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
            return probe.getsockname()[0]
        except OSError:
            return "127.0.0.2"


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", ["port", "edits", "database"])
def test_what_cannot_be_served_is_refused_before_it_listens(campaign, tmp_path, spoilt):
    folder = shutil.copytree(campaign, tmp_path / "campaign")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        more = ["--port", str(taken.getsockname()[1])] if spoilt == "port" else []
        if spoilt == "edits":
            (folder / "edits.toml").write_text("version = 2\n")
        elif spoilt == "database":
            folder = folder / "database"
            (folder / "catalogue.csv").touch()
        done = subprocess.run(
            [*COMMAND, str(folder), "--no-open", *more], capture_output=True, text=True, timeout=600
        )
    code = {"port": "E_PORT", "edits": "edits.toml", "database": "E_UNREADABLE"}[spoilt]
    assert done.returncode == 1 and code in done.stderr and done.stdout == ""


BROWSER = """
import json, pathlib, sys, urllib.parse, urllib.request
page = pathlib.Path(urllib.request.url2pathname(urllib.parse.urlsplit(sys.argv[2]).path))
record = {"path": str(page), "mode": page.stat().st_mode & 0o777, "text": page.read_text(encoding="utf-8")}
pathlib.Path(sys.argv[1] + ".part").write_text(json.dumps(record))
pathlib.Path(sys.argv[1] + ".part").rename(sys.argv[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="$BROWSER and signals of Unix")
@pytest.mark.parametrize(
    "end",
    [
        pytest.param(one, marks=[pytest.mark.slow] * (one not in ("entered", "SIGINT")))
        for one in ["entered", "SIGINT", "SIGTERM", "SIGHUP"]
    ],
)
def test_the_page_that_holds_the_token_is_this_users_and_is_taken_away(campaign, tmp_path, end):
    """By a browser's entry, or by any end that a terminal gives; nothing else is left either."""
    (tmp_path / "browser.py").write_text(BROWSER)
    (tmp_path / "temporary").mkdir()
    browser = f"{sys.executable} {tmp_path / 'browser.py'} {tmp_path / 'record.json'} %s"
    run = subprocess.Popen(
        [*COMMAND, str(campaign)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONUTF8": "1", "BROWSER": browser, "TMPDIR": str(tmp_path / "temporary")},
    )  # fmt: skip
    try:
        run.stdout.readline()
        for _ in range(6000):
            if (tmp_path / "record.json").is_file():
                break
            time.sleep(0.05)
        record = json.loads((tmp_path / "record.json").read_text())
        assert record["mode"] == 0o600
        page = Path(record["path"])
        address, token = re.search(r"url=(http://[\d.:]+)/#([\w-]{43})", record["text"]).groups()
        assert b"workbench.js" in send(address, "/").read() and page.is_file()
        if end == "entered":
            assert send(address, "/enter", body={"token": token}).status == 200
            assert not page.exists()
        run.send_signal(getattr(signal, end if end != "entered" else "SIGINT"))
        _, errors = run.communicate(timeout=600)
    finally:
        run.kill()
    assert run.returncode == 0 and errors == ""
    assert not page.exists() and list((tmp_path / "temporary").glob("levkas-*")) == []
