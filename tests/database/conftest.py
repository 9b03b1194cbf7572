"""Stores on this machine that answer badly, for what reads from afar."""

import pytest


class Unsteady:
    """A WSGI application that counts its requests, and answers some of them badly.

    `faults` gives, of every request, ``"500"``, ``"cut"`` (the body ends before the length that was
    promised), ``"short"`` (a whole answer of half the bytes), ``"changed"`` (a flipped byte) or None.
    """

    def __init__(self, app):
        self.app, self.requests, self.faults = app, [], lambda request: None

    def __call__(self, environ, start_response):
        name = environ["PATH_INFO"].encode("latin-1").decode()
        self.requests.append(request := f"{environ['REQUEST_METHOD']} {name}")
        fault = self.faults(request)
        if fault == "500":
            start_response("500 Internal Server Error", [("Content-Length", "0")])
            return [b""]
        if fault is None:
            return self.app(environ, start_response)
        from werkzeug.test import run_wsgi_app

        body, status, headers = run_wsgi_app(self.app, environ, buffered=True)
        data = b"".join(body)
        if fault == "changed":
            data = (
                data[: len(data) // 2]
                + bytes([data[len(data) // 2] ^ 1])
                + data[len(data) // 2 + 1 :]
            )
        else:
            data = data[: len(data) // 2]
        if fault == "short":
            headers["Content-Length"] = str(len(data))
        start_response(status, list(headers))
        return [data]


@pytest.fixture
def serving():
    """Serve WSGI applications on this machine; the addresses are taken away after the test."""
    import logging
    import threading

    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.CRITICAL)
    servers = []

    def serve(app):
        server = make_server("127.0.0.1", 0, app, threaded=True)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}"

    yield serve
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.fixture
def web(serving):
    """Serve a folder by ranges: ``web(folder)`` gives the address and the application."""
    from werkzeug.exceptions import HTTPException
    from werkzeug.utils import send_from_directory

    def serve(folder):
        def app(environ, start_response):
            try:
                name = environ["PATH_INFO"].lstrip("/").encode("latin-1").decode()
                answer = send_from_directory(folder, name, environ)
            except HTTPException as error:
                answer = error
            return answer(environ, start_response)

        unsteady = Unsteady(app)
        return serving(unsteady), unsteady

    return serve


@pytest.fixture
def s3(serving, monkeypatch):
    """A store like S3 with the bucket ``museum``, and the application that plays it."""
    import boto3
    from moto.server import DomainDispatcherApplication, create_backend_app

    unsteady = Unsteady(DomainDispatcherApplication(create_backend_app))
    for key, value in {
        "AWS_ENDPOINT_URL": serving(unsteady),
        "AWS_ACCESS_KEY_ID": "KEYKEYKEY",
        "AWS_SECRET_ACCESS_KEY": "SECRETSECRET",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(key, value)
    unsteady.client = boto3.client("s3")
    unsteady.client.create_bucket(Bucket="museum")
    unsteady.requests.clear()
    yield unsteady
    unsteady.faults = lambda request: None
    for found in unsteady.client.list_objects_v2(Bucket="museum").get("Contents", []):
        unsteady.client.delete_object(Bucket="museum", Key=found["Key"])
    unsteady.client.delete_bucket(Bucket="museum")
