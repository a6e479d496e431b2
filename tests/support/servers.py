"""Servers on this machine's loopback: files over HTTP with ranges, and a proxy that counts bytes and breaks."""

from __future__ import annotations

import math
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from urllib.request import Request, urlopen

import pytest

SECRET = "d0ntPr1ntTh1s"
"""Of the credentials: stands in no output."""


@dataclass
class FileServer:
    """Files of a folder over HTTP.

    Attributes
    ----------
    ranges : whether it gives parts of a file
    token : of the query without which nothing is given
    broken : answers that will end in the middle
    silent : whether it keeps all who ask for content waiting; waiting : how many are
    sent : bytes of content
    """

    folder: Path
    ranges: bool = True
    token: str = ""
    broken: int = 0
    silent: bool = False
    waiting: int = 0
    sent: int = 0
    url: str = ""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def keep_waiting(self) -> None:
        """Return when the server is not silent any more."""
        self.waiting += self.silent
        while self.silent:
            time.sleep(0.05)


class AnsweringHandler(BaseHTTPRequestHandler):
    """Answers HEAD and GET by one method, and writes no log."""

    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        self.answer(body=False)

    def do_GET(self) -> None:
        self.answer(body=True)

    def answer(self, *, body: bool) -> None:
        """Answer a request, without the content where `body` is False."""
        raise NotImplementedError

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def web_server(handler: type[AnsweringHandler]) -> Iterator[ThreadingHTTPServer]:
    """Serve on a free port of this machine until the block ends."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def file_server(folder: Path, **options: object) -> Iterator[FileServer]:
    """Serve a folder until the block ends."""
    serving = FileServer(folder, **options)

    class Handler(AnsweringHandler):
        def answer(self, *, body: bool) -> None:
            address = urlsplit(self.path)
            file = serving.folder / unquote(address.path).lstrip("/")
            if serving.token not in address.query:
                return self.send_error(403)
            if not file.is_file():
                return self.send_error(404)
            first, last = 0, file.stat().st_size - 1
            part = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", "")) if serving.ranges else None
            if part is not None:
                first, last = int(part[1]), min(int(part[2]), last)
            self.send_response(206 if part is not None else 200)
            self.send_header("Content-Length", str(last - first + 1))
            self.send_header("ETag", f'"{file.stat().st_mtime_ns}"')
            if part is not None:
                self.send_header("Content-Range", f"bytes {first}-{last}/{file.stat().st_size}")
            self.end_headers()
            if not body:
                return None
            serving.keep_waiting()
            with file.open("rb") as stream, suppress(OSError):
                stream.seek(first)
                left = last - first + 1
                with serving.lock:
                    breaks, serving.broken = serving.broken > 0, max(serving.broken - 1, 0)
                if breaks:
                    self.wfile.write(stream.read(left // 2))
                    self.close_connection = True
                    self.connection.shutdown(socket.SHUT_RDWR)
                    return None
                while piece := stream.read(min(left, 1 << 20)):
                    left -= len(piece)
                    with serving.lock:
                        serving.sent += len(piece)
                    self.wfile.write(piece)
            return None

    with web_server(Handler) as server:
        serving.url = f"http://127.0.0.1:{server.server_port}"
        yield serving


@dataclass
class Proxy:
    """A port that passes everything on to another one.

    Attributes
    ----------
    received, sent : bytes that came back, and that went there
    most_sent : after which every connection breaks
    client : of boto3, past the proxy, where it stands before an object store
    """

    port: int = 0
    received: int = 0
    sent: int = 0
    most_sent: float = math.inf
    client: Any = None
    lock: threading.Lock = field(default_factory=threading.Lock)


@contextmanager
def counting_proxy(target: int) -> Iterator[Proxy]:
    """Listen on a new port, and pass on to `target`, until the block ends."""
    listening = socket.create_server(("127.0.0.1", 0))
    proxy = Proxy(listening.getsockname()[1])

    def pass_on(source: socket.socket, sink: socket.socket, *, count: bool) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                with proxy.lock:
                    if count:
                        proxy.received += len(data)
                    else:
                        proxy.sent += len(data)
                if proxy.sent > proxy.most_sent:
                    break
                sink.sendall(data)
        for one in (source, sink):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def connect(client: socket.socket) -> None:
        with client, suppress(OSError), socket.create_connection(("127.0.0.1", target)) as server:
            back = threading.Thread(target=pass_on, args=(server, client), kwargs={"count": True}, daemon=True)
            back.start()
            pass_on(client, server, count=False)
            back.join()

    def serve() -> None:
        with suppress(OSError):
            while True:
                client, _ = listening.accept()
                threading.Thread(target=connect, args=(client,), daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield proxy
    finally:
        listening.close()


@contextmanager
def object_store() -> Iterator[Proxy]:
    """Run moto's server, with a bucket `field`, behind a proxy; address and credentials are set as a user sets them."""
    import boto3
    import s3fs
    from moto.server import ThreadedMotoServer

    s3fs.S3FileSystem.clear_instance_cache()
    server = ThreadedMotoServer(port=0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    with counting_proxy(port) as proxy:
        settings = {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{proxy.port}", "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": SECRET, "AWS_DEFAULT_REGION": "us-east-1",
        }  # fmt: skip
        patch = pytest.MonkeyPatch()
        for name, value in settings.items():
            patch.setenv(name, value)
        try:
            proxy.client = boto3.client("s3", endpoint_url=f"http://127.0.0.1:{port}")
            proxy.client.create_bucket(Bucket="field")
            yield proxy
            proxy.client.close()
        finally:
            # What moto holds outlives its server.
            urlopen(Request(f"http://127.0.0.1:{port}/moto-api/reset", method="POST")).close()
            patch.undo()
    server.stop()
