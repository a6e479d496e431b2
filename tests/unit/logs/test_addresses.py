"""Addresses: their secrets stand in no output, two that differ in their query are two, odd ones are refused."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import icrtool
from icrtool.cli.inputs import named_place
from icrtool.errors import ConfigError, IcrToolError, LogError
from icrtool.logs.containers import connection
from icrtool.logs.containers.connection import check_redirect, filesystem
from icrtool.logs.containers.open_log import open_log
from icrtool.logs.containers.source import SavedBytes, find_logs_at
from icrtool.records.input_limits import MOST_BYTES, SERVER_TIMEOUT_S, most_bytes, server_timeout_s
from icrtool.records.places import UrlPath, place_of
from icrtool.records.samples import InputFile
from support.scripts import load_script
from support.servers import AnsweringHandler, web_server

SECRET = "d0ntPr1ntTh1s"
FORMS = {
    "https://user:{s}@host/a.mcap": "https://host/a.mcap",
    "https://{s}@host/a.mcap": "https://host/a.mcap",
    "https://user:p@{s}@host/a.mcap": "https://host/a.mcap",
    "https://user:p/{s}@host/a.mcap": "https://host/a.mcap",
    "https://user:p?{s}@host/a.mcap": "https://…",
    "https://user:p#{s}@host/a.mcap": "https://…",
    "https://host/a.mcap?token={s}": "https://host/a.mcap",
    "https://host/a[1].mcap?token={s}": "https://host/a[1].mcap",
    "https://host/a(1).mcap?token={s}": "https://host/a(1).mcap",
    "https://host?token=a@{s}": "https://…",
    "https://host/?token=a@{s}": "https://host/",
    "https://host/a.mcap#access_token={s}": "https://host/a.mcap",
    "https://host/a.mcap?x=1?token={s}": "https://host/a.mcap",
    "https://host:8080/a@b.mcap?t={s}": "https://host:8080/a@b.mcap",
    "http://[::1]:80/a.mcap?t={s}": "http://[::1]:80/a.mcap",
    "s3://KEY:{s}@bucket/a.mcap": "s3://bucket/a.mcap",
    "s3://KEY:{s}/+x@bucket/a.mcap": "s3://bucket/a.mcap",
    "s3://KEY:12/{s}@bucket/a.mcap": "s3://bucket/a.mcap",
    "s3://KEY:{s}@bucket": "s3://bucket",
    "s3://bucket/a.mcap?X-Amz-Signature={s}": "s3://bucket/a.mcap",
    "s3://bucket/mon day/a [1].mcap?sig={s}": "s3://bucket/mon day/a [1].mcap",
    "az://box/a.mcap?sv=1&sig={s}%3D": "az://box/a.mcap",
    "S3://KEY:{s}@bucket/a.mcap": "S3://bucket/a.mcap",
    " https://user:{s}@host/a.mcap": "https://…",
    "\ufeffhttps://user:{s}@host/a.mcap": "https://…",
    "'s3://bucket/a.mcap?sig={s}'": "s3://…",
    "<https://host/a.mcap?t={s}>": "https://…",
    "URL:https://user:{s}@host/a.mcap": "https://…",
    "https:/user:{s}@host/a.mcap": "https://…",
    "https:///user:{s}@host/a.mcap": "https://…",
    "https:\\\\user:{s}@host\\a.mcap": "https://…",
    "ftp:\\\\user:{s}@host\\a.mcap": "ftp://…",
}
REFUSED = (
    "file:///dev/zero", "memory://x", "github://a:b@c/d", "ftp://host/a.mcap", "zip://a::s3://b/c.zip", "local://a",
    "simplecache::s3://b/a.mcap", "s3://b/a::file:///etc/passwd", "https://", "https:///a.mcap", "https://host:99999/a",
    "https://host:x/a", "http://[::1/a.mcap", "s3://", "s3://@/a", "https://ho st/\x1b[2J", "https://host\\a", "data://x",
)  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_no_secret_of_an_address_is_in_its_text_its_name_or_an_error(form: str) -> None:
    url = form.format(s=SECRET)
    place = place_of(url)
    assert isinstance(place, UrlPath)
    assert str(place) == FORMS[form]
    assert SECRET not in f"{place} {place.name} {place!r} {place.parts} {place / 'run'} {LogError(place, 'x')}"
    assert place.url == url
    assert SECRET not in place.without_own_secrets(f"GET {url} failed: {SECRET}")


@pytest.mark.parametrize("form", FORMS)
def test_below_an_address_its_secrets_stay_hidden(form: str) -> None:
    place = place_of(form.format(s=SECRET))
    assert SECRET not in f"{place / 'run' / 'a.csv'} {(place / 'run').name}"


@pytest.mark.parametrize("written", ["https://user:{s}@host/a.mcap", "https:/user:{s}@host/a.mcap"])
def test_an_address_that_a_script_gives_as_a_path_is_refused_without_its_secrets(written: str) -> None:
    for read in (icrtool.read_log, icrtool.open_run):
        with pytest.raises(IcrToolError, match="https://") as error:
            read(Path(written.format(s=SECRET)))
        assert SECRET not in str(error.value)


def test_the_name_of_a_group_stands_before_an_address_and_not_in_one() -> None:
    assert named_place("wet=https://host/a=b.mcap?c=d") == ("wet", UrlPath("https://host/a=b.mcap?c=d"))
    for address in ("https://host/a?token=b", "s3://bucket/x=1/a.mcap", "'https://host/a?token=b'"):
        assert named_place(address)[1] == UrlPath(address)


def test_an_address_of_any_length_leaves_space_for_the_reason() -> None:
    assert "no such file" in str(LogError(UrlPath(f"https://host/{'x' * 20_000}"), "no such file"))


def test_escaped_forms_of_a_secret_are_left_out_of_a_library_s_text() -> None:
    place = UrlPath("https://host/a.mcap?token=a%2Fb%2Bsecret")
    assert "secret" not in place.without_own_secrets("url a/b+secret; a%2Fb%2Bsecret")


@pytest.mark.parametrize("url", REFUSED)
def test_an_address_that_is_not_documented_is_refused_in_one_line(url: str) -> None:
    path = place_of(url)
    with pytest.raises(LogError) as error:
        filesystem(path if isinstance(path, UrlPath) else UrlPath(url))
    assert len(str(error.value).splitlines()) == 1
    assert str(error.value).isprintable()


def test_what_identifies_a_file_is_its_content_or_its_whole_address() -> None:
    def stated(url: str, **more: str) -> InputFile:
        return InputFile(str(UrlPath(url)), 9, None, address=UrlPath(url).digest, **more)

    one, two = "https://h/download?id=1", "https://h/download?id=2"
    assert stated(one).path == stated(two).path
    assert stated(one).identity != stated(two).identity
    assert stated(one, etag="a").identity == stated(two, etag="a").identity  # a new signature of the same content
    assert stated(one, etag="a").identity != stated(one, etag="b").identity
    assert stated(one, etag="Sat, 01 Jan 2026 00:00:00 GMT").identity[1] == UrlPath(one).digest
    assert InputFile("a", 9, "ab").identity == InputFile("b", 9, "ab").identity


@pytest.mark.parametrize("behind", ["?x::file:///etc/passwd", "?t=a::b"])
@pytest.mark.parametrize("scheme", ["https", "s3"])
def test_no_chain_is_followed_behind_a_question_mark(scheme: str, behind: str) -> None:
    pytest.importorskip("aiohttp" if scheme == "https" else "s3fs", reason="needs the extra icrtool[cloud]")
    files, name = filesystem(UrlPath(f"{scheme}://host/a.mcap{behind}"))
    assert scheme in files.protocol
    assert name.endswith(f"host/a.mcap{behind}")


@contextmanager
def lying_server(
    answer: bytes,
    forever: bytes = b"",
    *,
    pause_s: float = 0.0,
    stated: bytes = b"Content-Length: 1000000\r\n",
    head: bytes = b"",
) -> Iterator[tuple[str, list[int]]]:
    """Answer HEAD with a size of 1 MB, and GET with what is given; count what is sent."""
    listening = socket.create_server(("127.0.0.1", 0))
    sent = [0]

    def serve(client: socket.socket) -> None:
        with client:
            try:
                while request := client.recv(65536):
                    if request.startswith(b"HEAD"):
                        client.sendall(head or b"HTTP/1.1 200 OK\r\n" + stated + b'ETag: "a"\r\n\r\n')
                        continue
                    asked = re.search(rb"Range: bytes=(\d+-\d+)", request)
                    client.sendall(answer.replace(b"RANGE", asked[1] if asked is not None else b""))
                    while forever and sent[0] < 200_000_000:
                        client.sendall(forever)
                        sent[0] += len(forever)
                        time.sleep(pause_s)
                    return
            except OSError:
                return

    def accept() -> None:
        while True:
            try:
                client, _ = listening.accept()
            except OSError:
                return
            threading.Thread(target=serve, args=(client,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}/a.mcap", sent
    finally:
        listening.close()


CHUNK = b"10000\r\n" + bytes(65536) + b"\r\n"
CHUNKED = b"Transfer-Encoding: chunked\r\n"
LIES = {
    "200 without an end": b"HTTP/1.1 200 OK\r\n" + CHUNKED + b"\r\n",
    "another range": b"HTTP/1.1 206 P\r\nContent-Range: bytes 0-9/1000000\r\n" + CHUNKED + b"\r\n",
    "another size": b"HTTP/1.1 206 P\r\nContent-Range: bytes 999999-999999/5\r\n" + CHUNKED + b"\r\n",
    "no range stated": b"HTTP/1.1 206 P\r\n" + CHUNKED + b"\r\n",
    "an encoding": b"HTTP/1.1 206 P\r\nContent-Range: bytes 999999-999999/1000000\r\nContent-Encoding: gzip\r\n"
    + CHUNKED + b"\r\n",
    "a range without an end": b"HTTP/1.1 206 P\r\nContent-Range: bytes 999999-999999/1000000\r\n" + CHUNKED + b"\r\n",
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_server_that_lies_about_a_range_is_refused_and_little_is_read(lie: str) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    with lying_server(LIES[lie], CHUNK) as (url, sent), pytest.raises(LogError) as error:
        open_log(UrlPath(url))
    assert len(str(error.value).splitlines()) == 1
    assert sent[0] < 50_000_000  # what the sockets hold


REDIRECTS = {
    "10.0.0.1/a.mcap": "10.0.0.1, which has no public address",
    "169.254.169.254/latest/meta-data": "169.254.169.254, which has no public address",
    "[::1]:1/a.mcap": "::1, which has no public address",
    "localhost:1/a.mcap": "localhost, which has no public address",
}


@pytest.mark.parametrize("target", REDIRECTS)
def test_a_redirect_to_a_machine_that_others_do_not_reach_is_refused(target: str) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    away = f"HTTP/1.1 302 F\r\nLocation: http://{target}\r\nContent-Length: 0\r\n\r\n".encode()
    with lying_server(away) as (url, _), pytest.raises(LogError, match=re.escape(REDIRECTS[target])) as error:
        open_log(UrlPath(url))
    assert len(str(error.value).splitlines()) == 1


def test_a_redirect_from_https_to_http_or_a_file_is_refused_and_one_to_a_public_host_is_followed() -> None:
    yarl = pytest.importorskip("yarl", reason="needs the extra icrtool[http]")
    for target in ("http://host/a", "file:///etc/passwd"):
        with pytest.raises(ValueError, match="redirects from https://"):
            asyncio.run(check_redirect(yarl.URL("https://host/a"), yarl.URL(target)))
    asyncio.run(check_redirect(yarl.URL("https://host/a"), yarl.URL("https://93.184.215.14/a")))
    asyncio.run(check_redirect(yarl.URL("http://host/a"), yarl.URL("https://host/b")))


def test_a_server_that_redirects_to_another_place_of_its_own_is_read(tmp_path: Path) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    log = Path(__file__).parents[3] / "sample_logs" / "wheeled_lawnmower.mcap"
    with load_script("fuzz_addresses").odd_server(log.read_bytes()) as server:
        url = f"http://127.0.0.1:{server.server_port}/away-here.mcap"
        with contextlib.closing(open_log(UrlPath(url))) as container:
            assert container.channels


def test_a_silent_server_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    monkeypatch.setenv(SERVER_TIMEOUT_S, "0.3")
    start = b"HTTP/1.1 206 P\r\nContent-Range: bytes 999999-999999/1000000\r\nContent-Length: 1\r\n\r\n"
    with lying_server(start) as (url, _), pytest.raises(LogError):
        open_log(UrlPath(url))


SLOW = {
    "a range": b"HTTP/1.1 206 P\r\nContent-Range: bytes RANGE/1000000\r\n" + CHUNKED + b"\r\n1\r\n\0\r\n",
    "a file of a server without ranges": b"HTTP/1.1 200 OK\r\n" + CHUNKED + b"\r\n200\r\n"
    + b"\x89MCAP0\r\n".ljust(512, b"\0") + b"\r\n",
    "a page that lists a folder": b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n" + CHUNKED + b"\r\n",
}  # fmt: skip


@pytest.mark.parametrize("kind", SLOW)
def test_a_server_that_sends_a_byte_now_and_then_is_given_up(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    monkeypatch.setenv(SERVER_TIMEOUT_S, "1")
    began = time.monotonic()
    read: Callable[[UrlPath], object] = find_logs_at if kind == "a page that lists a folder" else open_log
    with lying_server(SLOW[kind], b"1\r\n\0\r\n", pause_s=0.05) as (url, _), pytest.raises(LogError) as error:
        read(UrlPath(url.replace("a.mcap", "folder/*.mcap") if read is find_logs_at else url))
    assert "sent nothing for 1 s, or less than 10 kB/s" in str(error.value)
    assert time.monotonic() - began < 15.0


SLOW_HEADERS = {
    "100 Continue without an end": (b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
    "a header without an end": (b"HTTP/1.1 200 OK\r\n", b"X"),
    "headers without an end": (b"HTTP/1.1 200 OK\r\n", b"X: y\r\n"),
}


@pytest.mark.parametrize("name", ["a.mcap", "folder/*.mcap"])
@pytest.mark.parametrize("kind", SLOW_HEADERS)
def test_a_server_whose_header_does_not_end_is_given_up(kind: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    monkeypatch.setenv(SERVER_TIMEOUT_S, "1")
    began = time.monotonic()
    read: Callable[[UrlPath], object] = find_logs_at if "*" in name else open_log
    with (
        lying_server(*SLOW_HEADERS[kind], pause_s=0.05) as (url, _),
        pytest.raises(LogError, match="sent nothing for 1 s"),
    ):
        read(UrlPath(url.replace("a.mcap", name)))
    assert time.monotonic() - began < 15.0


STORES = {
    "gs": ("gcsfs", {"STORAGE_EMULATOR_HOST": "http://127.0.0.1:{port}", "NO_GCE_CHECK": "true"}),
    "az": (
        "adlfs",
        {
            "AZURE_STORAGE_CONNECTION_STRING": "DefaultEndpointsProtocol=http;AccountName=a;AccountKey=a2V5;"
            "BlobEndpoint=http://127.0.0.1:{port}/a;"
        },
    ),
}
"""By scheme, the library, and what a user sets for a store on this machine."""


def set_store(scheme: str, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have addresses of a scheme lead to a port of this machine, for 0.5 s without an answer."""
    library, variables = STORES[scheme]
    pytest.importorskip(library, reason="needs the extra icrtool[cloud]")
    connection._answering_store.cache_clear()
    for name, value in variables.items():
        monkeypatch.setenv(name, value.format(port=port))
    monkeypatch.setenv(SERVER_TIMEOUT_S, "0.5")


@pytest.mark.parametrize("read", [open_log, find_logs_at], ids=["a file", "a pattern"])
@pytest.mark.parametrize("scheme", STORES)
def test_an_object_store_whose_host_is_dead_is_given_up(
    scheme: str, read: Callable[[UrlPath], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their libraries repeat requests for 35 s and more."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        set_store(scheme, free.getsockname()[1], monkeypatch)
    began = time.monotonic()
    with pytest.raises(LogError, match=r"sent nothing for 0\.5 s"):
        read(UrlPath(f"{scheme}://box/{'a' if read is open_log else '*'}.mcap"))
    assert time.monotonic() - began < 10.0


@pytest.mark.parametrize("status", [200, 403])
def test_an_object_store_that_answers_is_read_also_where_it_tells_nothing_of_its_bucket(
    status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = (Path(__file__).parents[3] / "sample_logs" / "wheeled_lawnmower.mcap").read_bytes()
    about = {"kind": "storage#object", "name": "a.mcap", "bucket": "box", "size": str(len(content)), "generation": "7"}
    asked = []

    class Bucket(AnsweringHandler):
        def answer(self, *, body: bool) -> None:
            asked.append(self.path)
            first, last = map(int, self.headers.get("Range", "bytes=0-0")[6:].split("-"))
            is_file, is_content = "/o/a.mcap" in self.path, "alt=media" in self.path
            found = content[first : last + 1] if is_content else json.dumps(about).encode()
            self.send_response(206 if is_content else 200 if is_file else status)
            self.send_header("Content-Length", str(len(found)))
            self.end_headers()
            self.wfile.write(found)

    with web_server(Bucket) as server:
        set_store("gs", server.server_port, monkeypatch)
        monkeypatch.setenv(SERVER_TIMEOUT_S, "15")
        with contextlib.closing(open_log(UrlPath("gs://box/a.mcap"))) as container:
            assert container.channels
    assert "/o/" not in asked[0]
    connection._answering_store.cache_clear()


NO_ANSWERS = {
    b"hello\n": "its server sent an answer that is not HTTP: Bad status line",
    b"HTTP/1.1 200 OK\r\nContent-Length: -5\r\n\r\n": "its server sent an answer that is not HTTP: Invalid character",
    b"HTTP/1.1 500 \x1b[2Jout\r\nContent-Length: 0\r\n\r\n": "its server answered 500",
}


@pytest.mark.parametrize("answer", NO_ANSWERS)
def test_what_a_server_answers_in_place_of_a_log_is_stated(answer: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    monkeypatch.setattr(connection, "PAUSES_S", ())
    with lying_server(answer, head=answer) as (url, _), pytest.raises(LogError, match=NO_ANSWERS[answer]) as error:
        open_log(UrlPath(url))
    assert str(error.value).isprintable()
    assert "\\n\\n" not in str(error.value)


def test_a_page_without_an_end_that_lists_a_folder_is_refused() -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    with lying_server(SLOW["a page that lists a folder"], CHUNK) as (url, sent), pytest.raises(LogError) as error:
        find_logs_at(UrlPath(url.replace("a.mcap", "folder/*.mcap")))
    assert len(str(error.value).splitlines()) == 1
    assert sent[0] < 60_000_000


def test_a_body_without_an_end_is_fetched_up_to_the_given_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra icrtool[http]")
    monkeypatch.setenv(MOST_BYTES, "2MB")
    with (
        lying_server(SLOW["a file of a server without ranges"], CHUNK, stated=b"") as (url, sent),
        pytest.raises(LogError, match=r"more than 2,000,000 bytes \(--most-bytes\)") as error,
    ):
        open_log(UrlPath(url))
    assert len(str(error.value).splitlines()) == 1
    assert sent[0] < 60_000_000


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("--most-bytes", "2MB"), "more than 2,000,000 bytes (--most-bytes)"),
        (("--most-bytes", "1e9"), "is no number of bytes"),
        (("--server-timeout", "-1"), "is no number of seconds above 0"),
        (("--server-timeout", "inf"), "is no number of seconds above 0"),
    ],
)
def test_a_log_without_an_end_on_standard_input_is_one_line(given: tuple[str, str], words: str) -> None:
    command = [sys.executable, "-P", "-m", "icrtool", "info", "-", *given, "-q"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(b"\x89MCAP0\r\n")
            for _ in range(500):
                process.stdin.write(bytes(1 << 16))
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        errors = process.stderr.read().decode()
    assert process.returncode in (1, 2)
    assert words in errors.splitlines()[-1]
    assert "Traceback" not in errors


def test_without_a_limit_half_of_the_free_space_is_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9_000, 3_000, 6_000))
    saved = SavedBytes.into(tmp_path)
    saved.check(Path("-"), 3_000)
    with pytest.raises(LogError, match="more than 3,000 bytes"):
        saved.check(Path("-"), 3_001)


@pytest.mark.parametrize(("text", "count"), [("800000", 800_000), ("500M", 500_000_000), ("2.5GB", 2_500_000_000)])
def test_bytes_are_stated_with_or_without_a_unit(text: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(MOST_BYTES, text)
    assert most_bytes() == count


def test_a_limit_of_the_environment_that_is_none_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(MOST_BYTES, "much")
    monkeypatch.setenv(SERVER_TIMEOUT_S, "0")
    with pytest.raises(ConfigError, match=MOST_BYTES):
        most_bytes()
    with pytest.raises(ConfigError, match=SERVER_TIMEOUT_S):
        server_timeout_s()


def test_standard_input_that_is_no_log_is_refused_by_its_first_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    import io
    import sys

    class Endless(io.RawIOBase):
        given = 0

        def readable(self) -> bool:
            return True

        def readinto(self, space: memoryview) -> int:  # type: ignore[override]
            self.given += len(space)
            return len(space)

    stream = Endless()
    monkeypatch.setattr(sys, "stdin", type("In", (), {"buffer": stream, "isatty": lambda _: False, "closed": False})())
    with pytest.raises(LogError, match="not a log"):
        open_log(Path("-"))
    assert stream.given <= 4096
