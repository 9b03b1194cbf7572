"""A database on a store that answers after a delay: requests, bytes and seconds; whole, and with bad answers.

python benchmarks/remote.py [DELAY_MS]
"""

import logging
import os
import random
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

import boto3
import numpy as np
from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import make_server

import levkas
from levkas.core.cube import Band, Cube
from levkas.core.problems import Refused
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest
from levkas.database.store import write_index
from levkas.database.validation import validate

SHAPE = (1040, 1392, 33)
ADDRESS = "s3://museum/icons"


class Store:
    """moto behind a delay, which counts requests and now and then answers with an error 500."""

    def __init__(self, delay_s: float) -> None:
        self.app = DomainDispatcherApplication(create_backend_app)
        self.delay_s, self.bad, self.rng = delay_s, 0.0, random.Random(1)
        self.requests = self.bytes = self.failed = 0

    def __call__(self, environ, start_response):
        time.sleep(self.delay_s)
        self.requests += 1
        if self.rng.random() < self.bad:
            self.failed += 1
            start_response("500 Internal Server Error", [("Content-Length", "0")])
            return [b""]
        body = b"".join(self.app(environ, start_response))
        self.bytes += len(body)
        return [body]


def make_database(folder: Path) -> Path:
    """Write one object of one camera, noisy, at full size."""
    rng = np.random.default_rng(1)
    values = rng.normal(0.5, 0.05, SHAPE).astype(np.float32)
    bands = tuple(Band(f"{400 + 10 * i} nm", 400.0 + 10 * i, 10.0) for i in range(SHAPE[2]))
    cube = Cube(values, np.zeros(SHAPE, np.uint8), np.abs(values) / 100, bands)
    write_catalogue(folder, [write_layer(folder, Layer("icon1", "lctf-vis"), cube)[0]])
    write_index(folder / "zarr/icon1.zarr")
    write_manifest(folder)
    return folder


def measure(store: Store, what: str, work):
    """Print a row: requests, bytes that came, seconds."""
    store.requests = store.bytes = 0
    started = time.perf_counter()
    found = work()
    seconds = time.perf_counter() - started
    print(f"| {what} | {store.requests} | {store.bytes / 1e6:.1f} | {seconds:.2f} |", flush=True)
    return found


def main() -> None:
    """Print the table."""
    delay_ms = float(sys.argv[1]) if len(sys.argv) > 1 else 30.0
    logging.getLogger("werkzeug").setLevel(logging.CRITICAL)
    store = Store(delay_ms / 1000)
    server = make_server("127.0.0.1", 0, store, threaded=True)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    os.environ |= {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}",
        "AWS_ACCESS_KEY_ID": "of-the-benchmark",
        "AWS_SECRET_ACCESS_KEY": "of-the-benchmark",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    client = boto3.client("s3")
    client.create_bucket(Bucket="museum")
    folder = Path(tempfile.mkdtemp())
    try:
        database = make_database(folder / "icons")
        total = sum(p.stat().st_size for p in database.rglob("*") if p.is_file())
        count = sum(p.is_file() for p in database.rglob("*"))
        print(f"{count} files, {total / 1e6:.0f} MB; every answer comes after {delay_ms:g} ms\n")
        print("| what | requests | MB | s |\n|---|---:|---:|---:|")
        for path in sorted(p for p in database.rglob("*") if p.is_file()):
            client.upload_file(
                str(path), "museum", f"icons/{path.relative_to(database).as_posix()}"
            )
        opened = measure(store, "open", lambda: levkas.open(ADDRESS))
        layer = measure(store, "a layer", lambda: opened["icon1"]["lctf-vis"])
        spectrum = measure(store, "a spectrum", lambda: layer.isel(x=700, y=500).values)
        measure(store, "its neighbour", lambda: layer.isel(x=701, y=500).values)
        measure(store, "a band", lambda: layer.isel(band=16).values)
        here = levkas.open(database)["icon1"]["lctf-vis"]
        assert np.array_equal(spectrum, here.isel(x=700, y=500).values)
        report = measure(store, "validate", lambda: validate(ADDRESS))
        assert report.ok
        store.bad = 0.05
        wrong = refused = 0
        for place in range(0, 1000, 20):
            try:
                there = levkas.open(ADDRESS)["icon1"]["lctf-vis"].isel(x=place, y=place).values
                wrong += not np.array_equal(there, here.isel(x=place, y=place).values)
            except Refused:
                refused += 1
        print(f"\n50 spectra, 5 % errors 500 ({store.failed}): {wrong} wrong, {refused} refused")
    finally:
        server.shutdown()
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
