"""Odd addresses, used by each command as a log, a place of results or an option, as `scripts/fuzz.py --addresses` asks.

A finding is a traceback, an error that is not one line of reason and advice, a secret of the address in what is
printed or written, or a connection to another place than the one that the address shows.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from http.server import ThreadingHTTPServer
from ipaddress import ip_address
from pathlib import Path
from random import Random
from typing import Any, NamedTuple
from unittest import mock
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "tests")]

from fuzz_runs import called  # noqa: E402 - beside this script

from support.batches import in_this_process  # noqa: E402 - the tests are no package
from support.servers import SECRET, AnsweringHandler, object_store, web_server  # noqa: E402

COMMANDS = (
    ("info", "A"), ("info", "A", "--json"), ("info", "A", "LOG"), ("fit", "A", "--plots", "none"),
    ("fit", "A", "LOG", "--into", "out", "--plots", "none", "-q"), ("fit", "LOG", "-o", "A", "--plots", "none"),
    ("fit", "LOG", "--into", "A", "--plots", "none"), ("fit", "LOG", "--warm-start", "A", "--plots", "none"),
    ("fit", "LOG", "--config", "A"), ("dropout-report", "A", "--plots", "none", "--no-ladder", "--no-page"),
    ("dropout-report", "OWN", "-o", "A"),
    ("dropout-report", "OWN", "--baseline", "A", "--plots", "none", "--no-ladder"),
    ("dropout-report", "OWN", "--calibration", "A", "--plots", "none", "--no-ladder"),
    ("dropout-report", "OWN", "--junit", "A", "--markdown", "A", "--plots", "none", "--no-ladder"),
    ("calibrate", "A", "-o", "cal.json"), ("calibrate", "wet=A", "dry=OWN"), ("calibrate", "OWN", "-o", "A"),
    ("calibrate", "OWN", "--plot", "A"), ("compare", "A", "own=OWN"), ("compare", "new=A", "OWN"),
    ("forecast", "--calibration", "A", "--path", "OWN"), ("forecast", "--calibration", "OWN", "--path", "A"),
    ("export", "--for", "json", "A"), ("export", "--for", "evo", "OWN", "-o", "A"), ("report", "A"),
    ("report", "OWN", "-o", "A"), ("batch", "A", "-o", "out", "--plots", "none", "-q"),
    ("batch", "MANIFEST", "-o", "out", "--plots", "none"), ("batch", "LOG", "-o", "A", "--plots", "none", "-q"),
    ("simulate", "-o", "A", "--duration", "5"),
)  # fmt: skip
"""Commands in which A is an address, OWN a run, LOG a log, and MANIFEST a table that names the address."""

ROBOT = ("--set", "robot.wheel_radius_m=0.165", "--set", "robot.track_width_m=0.55")
WITH_ROBOT = ("info", "fit", "dropout-report", "calibrate", "compare", "batch")

SCHEMES = ("s3", "s3a", "http", "https", "gs", "gcs", "az", "abfs", "abfss")
OTHERS = (
    "file", "memory", "github", "ftp", "sftp", "data", "zip", "local", "simplecache", "filecache", "reference",
    "hf", "smb", "git", "webhdfs", "dbfs", "jar", "javascript", "a+b.c-d",
)  # fmt: skip
HOSTS = (
    "localhost", "127.1", "2130706433", "0x7f.1", "0", "[::1]", "[::ffff:127.0.0.1]", "[fe80::1%25eth0]", "[::1",
    "::1]", "[v1.x]", "host.invalid", "bücher.example", "xn--bcher-kva.example", "ｌocalhost", "\u202egro.elpmaxe",
    "a..b", ".", "..", "-", "*", "%31%32%37.0.0.1", "%2e", "%00", "a" * 64 + ".example", "a" * 300, "", " ", "a b",
    "host,other", "metadata.google.internal", "169.254.169.254", "user", "ß.example", "a_b", "\x7f", "☃",
    "1.2.3.4.5", "field",
)  # fmt: skip
PORTS = (
    "", "", "", ":0", ":1", ":99999", ":-1", ":x", ":", ":+80", ": 80", ":٣", ":0x50", ":80:80", ":" + "9" * 400,
)  # fmt: skip
NAMES = (
    "a.mcap", "log.mcap", "a?1.mcap", "a[1].mcap", "a[!b].mcap", "b#2.mcap", "*.mcap", "**", "**/*.mcap", "..",
    "../..", ".", "%2e%2e", "%2e%2e/%2e%2e/x.mcap", "..%2f..%2fx.mcap", "x%00.mcap", "\0", "a\nError: x.mcap",
    "a\r\n", "\x1b[2J.mcap", "\u202ecapm.a", "\u2066a\u2069.mcap", "é.mcap", "e\u0301.mcap", "a b.mcap", "a+b.mcap",
    "%", "%zz", "%e2%80%ae.mcap", "x" * 300 + ".mcap", "x" * 20_000, "d/" * 3000 + "a.mcap", "//a.mcap",
    "/etc/passwd", "~/a.mcap", "{0..3}.mcap", "a_{0..99999999}.mcap", "{a,b}.mcap", "a.mcap/", "metadata.yaml",
    "run.json", "calibration.json", "cal.json", "report.json", "missing", "missing.mcap", "a@b.mcap", "a:b.mcap",
    "a;b.mcap", "a=b.mcap", "a\\b.mcap", "$HOME", "`id`", "\ud800.mcap", "-", "--config=x", "[", "]", "[]", "[[",
    "***", "listing/", "listing/*.mcap",
    *(f"away{one}.mcap" for one in ("", "-in", "-here", "-file", "-odd", "-six", "-loop")), "folder/", "a::b",
    "x::s3://field/a.mcap", "NUL", "con.mcap", "a.mcap.gz", "a.zip", "a.csv", "a.png",
)  # fmt: skip
PLAIN = (
    "log.mcap", "a.mcap", "a[1].mcap", "a b.mcap", "é.mcap", "..", "%2e%2e", ".", "a%20b.mcap", "listing/",
    "*.mcap",
)  # fmt: skip
BETWEEN = (
    "", "", "", "@", "/", ":", "%", "%2F", "%40", "+", "=", "?", "#", "\\", "[", "é", "&", "%25", ";", " ", "@@",
    "//",
)  # fmt: skip
QUERIES = (
    "", "", "", "?", "#", "?token={0}", "?a=1&sig={0}", "?x=[{0}]", "?t=a@{0}", "?t={0}/../b", "?t=%7B{0}%7D",
    "?a?{0}", "?t={0}#{1}", "#access={0}", "?t={0}::{1}", "?u=http://x:{0}@y/z", "?t={0}\n{1}",
    "?X-Amz-Signature={0}%2B{1}", "?*{0}", "?" + "a=1&" * 5000 + "t={0}",
)  # fmt: skip
WRAPPED = ("{0}",) * 150 + (" {0}", "{0} ", "\ufeff{0}", "\t{0}", "zip://a.mcap::{0}", "simplecache::{0}", "{0}::file:///etc/passwd",
           "URL:{0}", "<{0}>", "'{0}'", "view-source:{0}")  # fmt: skip


class OddAddress(NamedTuple):
    """An address, and its secrets: parts of its user, password and query."""

    text: str
    secrets: tuple[str, ...]


def make_address(random: Random, port: int) -> OddAddress:
    """Return an address; in half of the cases one that leads to the server on this machine, or to the object store."""
    secrets = tuple(f"hush{random.randrange(16**10):010x}" for _ in range(4))
    scheme = random.choice(SCHEMES[:4]) if random.random() < 0.85 else random.choice((*SCHEMES, *OTHERS))
    if random.random() < 0.6:
        host = "field" if scheme.startswith("s3") else f"127.0.0.1:{port}"
    else:
        host = random.choice(HOSTS) + random.choice(PORTS)
    if scheme == "https" and str(port) in host:
        scheme = "http"
    user = ""
    if random.random() < 0.35:
        first, second = random.choice(BETWEEN), random.choice(BETWEEN)
        password = f"{secrets[1]}{second}{secrets[0]}"
        user = random.choice([f"{secrets[0]}{first}:{password}@", f"user:{password}@", f":{secrets[1]}@"])
        if re.match(r"[^:]*/|.*@.*/|[^@]*:\d*/", user):
            # a host, a port and a path
            user = user.replace("/", "%2F")
    path = "".join(
        f"/{name}"
        for name in random.choices(NAMES if random.random() < 0.6 else PLAIN, k=random.choice([0, 1, 1, 1, 2, 3]))
    )
    query = random.choice(QUERIES).format(*secrets[2:])
    slashes = random.choice(["://"] * 40 + [":/" if scheme in SCHEMES else "://", ":///", ":\\\\"])
    if query.startswith("#") and not scheme.startswith("http"):
        query = ""  # the name of an object
    scheme = random.choice([scheme] * 20 + [scheme.upper(), scheme.title()])
    text = random.choice(WRAPPED).replace("{0}", f"{scheme}{slashes}{user}{host}{path}{query}")
    # what no command line can hold
    text = text.replace("\0", "\1").replace("\ud800", "\udcff")
    return OddAddress(text, tuple(secret for secret in secrets if secret in text))


@contextmanager
def servers(log: Path) -> Iterator[int]:
    """Serve a log at every address of a web server, and at odd names of an object store; yield the server's port."""
    content = log.read_bytes()
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    with odd_server(content) as server, object_store() as store, mock.patch.dict(os.environ, ENVIRONMENT):
        for name in NAMES:
            if len(name.encode("utf-8", "replace")) < 1000 and name.isprintable() and "missing" not in name:
                store.client.put_object(Bucket="field", Key=name.lstrip("/"), Body=content)
        yield server.server_port


@contextmanager
def odd_server(content: bytes) -> Iterator[ThreadingHTTPServer]:
    """Serve a content, or a part of it, at almost every address; some are redirects and pages."""

    class Handler(AnsweringHandler):
        def answer(self, *, body: bool) -> None:
            path, first, last, status = urlsplit(self.path).path, 0, len(content), 200
            if "missing" in path or ".json" in path:
                return self.send_error(404)
            away = next((target for name, target in REDIRECTS.items() if name in path), "")
            page = b""
            if path.endswith("/"):
                page = b'<a href="a.mcap">a</a><a href="http://elsewhere.invalid/b.mcap">b</a><a href="../../c.mcap">'
            part = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            if part is not None and not page and not away:
                status, first, last = 206, int(part[1]), min(int(part[2]) + 1, len(content))
            self.send_response(302 if away else status)
            if away:
                self.send_header("Location", away)
            if status == 206:
                self.send_header("Content-Range", f"bytes {first}-{last - 1}/{len(content)}")
            given = b"" if away else page or content[first:last]
            self.send_header("Content-Type", "text/html" if page else "application/octet-stream")
            self.send_header("Content-Length", str(len(given)))
            self.end_headers()
            if body:
                self.wfile.write(given)
            return None

    with web_server(Handler) as server:
        server.handle_error = lambda *_: None  # type: ignore[method-assign]  # a client that breaks off
        yield server


REDIRECTS = {
    "away.mcap": "http://10.0.0.1/a.mcap", "away-in.mcap": "http://169.254.169.254/latest/meta-data/",
    "away-here.mcap": "/log.mcap", "away-file.mcap": "file:///etc/passwd", "away-odd.mcap": "http://[",
    "away-six.mcap": "http://[::1]:1/a", "away-loop.mcap": "/away-loop.mcap",
}  # fmt: skip
"""Names to which the web server answers with a redirect, and where it leads."""

ENVIRONMENT = {
    "ICRTOOL_SERVER_TIMEOUT_S": "2", "AZURE_STORAGE_ACCOUNT_NAME": "account", "AZURE_STORAGE_ACCOUNT_KEY": "a2V5",
    "AWS_MAX_ATTEMPTS": "1", "AWS_EC2_METADATA_DISABLED": "true", "NO_GCE_CHECK": "true",
    "GOOGLE_APPLICATION_CREDENTIALS": "/nowhere.json",
}  # fmt: skip
PROVIDERS = re.compile(
    r"(.*\.)?(googleapis\.com|google\.internal|windows\.net|amazonaws\.com|microsoftonline\.com)|169\.254\.169\.254"
)


class Connections:
    """The hosts to which connections were asked for; only those to the servers of the fuzzer are made."""

    def __init__(self, ports: set[int]) -> None:
        self.hosts: list[str] = []
        self._ports = ports

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Note each host that is looked up or connected to, and refuse others than this machine."""
        look_up, connect = socket.getaddrinfo, socket.socket.connect

        def looked_up(host: object, port: object, *given: object, **named: object) -> object:
            name = host.decode("ascii", "replace") if isinstance(host, bytes) else str(host)
            if is_number(name):
                return look_up(host, port, *given, **named)
            self.hosts.append(name)
            if name == "localhost":
                return look_up("127.0.0.1", port, *given, **named)
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

        def connected(self_: socket.socket, address: object) -> None:
            if isinstance(address, tuple):
                self.hosts.append(str(address[0]))
                if address[0] != "127.0.0.1" or address[1] not in self._ports:
                    raise ConnectionRefusedError(111, "Connection refused")
            connect(self_, address)

        with (
            mock.patch.object(socket, "getaddrinfo", looked_up),
            mock.patch.object(socket.socket, "connect", connected),
            mock.patch.object(socket.socket, "connect_ex", connected),
        ):
            yield


def make_case(folder: Path, own: Path, log: Path, seed: int, port: int) -> tuple[OddAddress, tuple[str, ...]]:
    """Return an address and a command that uses it; the folder has a log, a run and a manifest."""
    random = Random(seed)  # noqa: S311 - the same again
    address, command = make_address(random, port), random.choice(COMMANDS)
    shutil.copyfile(log, folder / "log.mcap")
    if "OWN" in command:
        shutil.copytree(own, folder / "own-run")
    if "MANIFEST" in command:
        (folder / "manifest.csv").write_text(f'log\n"{address.text}"\n', errors="surrogateescape")
    return address, command


def use_address(folder: Path, address: OddAddress, command: tuple[str, ...], port: int) -> str:
    """Run a command with an address; return how it ended.

    Raises
    ------
    AssertionError
        A rule was broken.
    """
    from icrtool.logs.containers import connection
    from icrtool.records.places import place_of

    command = (*command, *(ROBOT if command[0] in WITH_ROBOT else ()))
    names = {"LOG": "log.mcap", "OWN": "own-run", "MANIFEST": "manifest.csv"}
    given = [
        names.get(part, address.text if part == "A" else re.sub(r"=A$", lambda _: f"={address.text}", part))
        for part in command
    ]
    store = urlsplit(os.environ["AWS_ENDPOINT_URL"]).port or 0
    connections = Connections({port, store})
    before = {str(path) for path in folder.rglob("*")}
    outside = {path.name for path in folder.parent.iterdir()}
    with (
        connections.watched(),
        mock.patch.object(connection, "PAUSES_S", ()),
        mock.patch("gcsfs.retry.min", return_value=0.0, create=True),
        mock.patch("azure.storage.blob._shared.policies_async.ExponentialRetry.get_backoff_time", return_value=0.0),
        mock.patch("icrtool.fleet.batch.process_apart", in_this_process),
    ):
        status, output, errors = called(given, folder)
    said, lines = output + errors, (output + errors).splitlines()
    written = [path for path in folder.rglob("*") if str(path) not in before]
    error = next((line for line in errors.splitlines() if line.startswith("Error: ")), "")
    shown = str(place_of(address.text))
    objects = written_objects() if connections.hosts and not shown.lower().startswith("http") else {}
    strangers = [host for host in connections.hosts if not is_typed(host, shown)]
    secrets = [*address.secrets, SECRET]
    quiet = "-q" in given
    faults = {
        f"status {status}": status not in (0, 1, 2, 3) or (bool(error) != (status in (1, 2)) and not quiet),
        "not printable": not all(line.isprintable() for line in lines),
        "a traceback or a warning of a library": re.search(r"Traceback|\w+Warning: ", said) is not None,
        "an error without a reason": bool(error) and not re.match(r"Error: .+: .+", error),
        "a secret in what is printed": any(one in said for one in secrets),
        "a secret in a name": any(one in str(path) for one in secrets for path in written),
        "a secret in a file": any(
            one.encode() in path.read_bytes() for path in written if path.is_file() for one in secrets
        ),
        "a secret in an object": any(one.encode() in content for content in objects.values() for one in secrets),
        f"a connection to {strangers}": bool(strangers),
        "files outside of its folder": {path.name for path in folder.parent.iterdir()} - outside != set(),
    }
    if found := [what for what, is_so in faults.items() if is_so]:
        raise AssertionError(f"{address.text[:300]!r}: {' '.join(command)}: {', '.join(found)}: {said[-1500:]!r}")
    kind = "connected" if connections.hosts else "no connection"
    return f"{command[0]}: {'done' if not status else 'refused'}, {kind}"


@cache
def client() -> Any:  # noqa: ANN401 - of a library
    """Return a client of the object store."""
    import boto3

    return boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"])


def written_objects() -> dict[str, bytes]:
    """Return the objects that a command wrote into the store, and remove them."""
    kept, found = {name.lstrip("/") for name in NAMES}, {}
    for one in client().list_objects_v2(Bucket="field").get("Contents", []):
        if (name := one["Key"]) not in kept:
            found[name] = client().get_object(Bucket="field", Key=name)["Body"].read()
            client().delete_object(Bucket="field", Key=name)
    return found


def is_number(host: str) -> bool:
    """Return whether a host is an IP address, which is not looked up."""
    try:
        ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True


def is_typed(host: str, shown: str) -> bool:
    """Return whether a host is the one that an address shows, or the provider's of an object store."""
    scheme, _, rest = shown.partition("://")
    if not scheme.lower().startswith("http"):
        return host in ("127.0.0.1", "localhost") or PROVIDERS.fullmatch(host) is not None
    try:
        typed = urlsplit(f"http://{rest}").hostname or ""
    except ValueError:
        return False
    return bool(forms(host) & forms(typed))


def forms(host: str) -> set[str]:
    """Return the ways to write a host."""
    from yarl import URL

    found = {host.lower(), unquote(host).lower()}
    for one in tuple(found):
        with suppress(ValueError):
            found.add(URL(f"http://{one}").raw_host or "")
        with suppress(UnicodeError):
            found.add(one.encode("idna").decode())
        with suppress(ValueError):
            found.add(str(ip_address(one.partition("%")[0])))
        with suppress(OSError, ValueError):
            found.add(socket.inet_ntoa(socket.inet_aton(one)))
    return found | ({"localhost", "127.0.0.1"} if found & {"localhost", "127.0.0.1"} else set())
