"""Results in an object store (moto's server, with s3fs): whole or not counted, continued, rolled up, no secrets."""

from __future__ import annotations

import errno
import functools
import hashlib
import json
import os
import queue
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import icrtool
from icrtool import pipeline
from icrtool.cli import main
from icrtool.errors import OutputError, RunError
from icrtool.output.files import remote_place
from icrtool.output.files.atomic import writer_id
from icrtool.output.files.remote_place import folder_on_disk
from icrtool.records.places import UrlPath
from support.batches import in_this_process
from support.servers import SECRET, object_store

ROBOT = ("--robot", "husky-a200")
PART_BYTES = 100_000
"""Of a run: after them connections break."""
QUICK = ("--plots", "none", "--no-ladder", "--no-page")

pytestmark = [
    pytest.mark.skipif(find_spec("s3fs") is None, reason="needs the extra icrtool[cloud]"),
    pytest.mark.skipif(find_spec("moto") is None, reason="needs moto, of the extra icrtool[dev]"),
    pytest.mark.skipif(sys.platform == "win32", reason="servers as threads of this process"),
]


@pytest.fixture(scope="module")
def server():
    with object_store() as store:
        yield store


@pytest.fixture
def store(server, tmp_path, monkeypatch):
    """The object store with an empty bucket; one attempt a request, and a folder of its own for temporary files."""
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    for name in names(server):
        server.client.delete_object(Bucket="field", Key=name)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
    yield server
    assert not list((tmp_path / "temporary").iterdir())


@pytest.fixture(scope="module")
def fitted_once():
    """The function that fits a log, which fits each log once for each request; a command still reads its log.

    The results that are uploaded are those of that log; fitting it again would show nothing about the upload.
    """
    fitted = {}

    def fit_log(log, config, request, **how):
        key = repr((log.inputs, config, request))
        if key not in fitted:
            fitted[key] = pipeline_fit(log, config, request, **how)
        return fitted[key]

    pipeline_fit = pipeline.fit_log
    return fit_log


@pytest.fixture(autouse=True)
def fits_once(fitted_once, monkeypatch):
    monkeypatch.setattr(pipeline, "fit_log", fitted_once)


@pytest.fixture
def mcap(short_logs: Path) -> Path:
    return short_logs / "field.mcap"


@pytest.fixture
def bag(short_logs: Path) -> Path:
    return short_logs / "other.bag"


def names(store, prefix: str = "") -> list[str]:
    found = store.client.list_objects_v2(Bucket="field", Prefix=prefix).get("Contents", [])
    return [one["Key"].removeprefix(prefix) for one in found]


def content(store, name: str) -> bytes:
    return store.client.get_object(Bucket="field", Key=name)["Body"].read()


def run(monkeypatch, capfd, *arguments: object) -> tuple[int, str]:
    """Run a command in this process; return its exit status and all that it printed."""
    monkeypatch.setattr(sys, "argv", ["icrtool", *map(str, arguments)])
    status = 0
    try:
        main()
    except SystemExit as left:
        status = int(left.code or 0)
    said = "".join(capfd.readouterr())
    assert SECRET not in said
    return status, said


def test_a_run_at_an_address_is_that_on_disk_and_its_report_is_added_there(store, tmp_path, monkeypatch, capfd, mcap):
    assert run(monkeypatch, capfd, "fit", mcap, *ROBOT, "-o", "one", "--plots", "none")[0] == 0
    status, said = run(monkeypatch, capfd, "fit", mcap, *ROBOT, "-o", "s3://field/runs/one", "--plots", "none")
    assert status == 0, said
    assert "s3://field/runs/one" in said
    written = sorted(str(file.relative_to(tmp_path / "one")) for file in (tmp_path / "one").rglob("*"))
    assert sorted(names(store, "runs/one/")) == written
    for name in set(written) - {"run.json"}:
        assert content(store, f"runs/one/{name}") == (tmp_path / "one" / name).read_bytes()

    before = content(store, "runs/one/B2SUMS")
    assert run(monkeypatch, capfd, "dropout-report", "s3://field/runs/one", *QUICK)[0] == 0
    assert "runs/one/dropout/summary.csv" in names(store)
    after = content(store, "runs/one/B2SUMS")
    assert after.startswith(before)
    assert b"dropout/summary.csv" in after
    assert run(monkeypatch, capfd, "dropout-report", "one", *QUICK)[0] == 0
    summary = "dropout/summary.csv"
    assert content(store, f"runs/one/{summary}") == (tmp_path / "one" / summary).read_bytes()
    assert not [name for name in names(store) if SECRET.encode() in content(store, name)]

    theirs, ours = icrtool.open_run("s3://field/runs/one"), icrtool.open_run("one")
    np.testing.assert_array_equal(theirs.states.to_numpy(), ours.states.to_numpy())
    for place in ("s3://field/runs/one", "one"):
        assert run(monkeypatch, capfd, "calibrate", place, "-o", f"{place[-3:]}{len(place)}.json", "-q")[0] == 0
    status, refusal = run(monkeypatch, capfd, "report", "s3://field/runs/one")
    assert status == 1
    assert "s3://field/runs/one: is a run at an address; copy it to a disk" in refusal
    assert len(refusal.splitlines()) == 1
    said = [run(monkeypatch, capfd, "export", "--for", "kml", place)[1] for place in ("s3://field/runs/one", "one")]
    assert said[0] == said[1]
    first, second = (json.loads(file.read_text())["parameters"] for file in tmp_path.glob("*.json"))
    assert first == second


def test_an_upload_that_breaks_leaves_no_run_that_counts_and_is_made_again(store, monkeypatch, capfd, mcap):
    fit = ("fit", mcap, *ROBOT, "-o", "s3://field/runs/one", "--plots", "none")
    store.most_sent = store.sent + PART_BYTES
    status, said = run(monkeypatch, capfd, *fit)
    store.most_sent = float("inf")
    assert status == 1
    (line,) = [one for one in said.splitlines() if one.startswith("Error: ")]
    assert "s3://field/runs/one: cannot be written" in line
    left = names(store, "runs/one/")
    assert "run.json" in left
    assert "B2SUMS" not in left
    with pytest.raises(RunError):
        icrtool.open_run("s3://field/runs/one")
    assert run(monkeypatch, capfd, *fit)[0] == 0
    assert run(monkeypatch, capfd, *fit[:-4], "-o", "here", "--plots", "none")[0] == 0
    theirs, ours = icrtool.open_run("s3://field/runs/one"), icrtool.open_run("here")
    np.testing.assert_array_equal(theirs.states.to_numpy(), ours.states.to_numpy())


def test_a_run_that_is_replaced_does_not_count_before_it_is_whole(store, monkeypatch, capfd, mcap):
    fit = ("fit", mcap, *ROBOT, "-o", "s3://field/runs/one", "--plots", "none")
    assert run(monkeypatch, capfd, *fit, "--smooth")[0] == 0
    store.most_sent = store.sent + PART_BYTES
    assert run(monkeypatch, capfd, *fit)[0] == 1
    store.most_sent = float("inf")
    assert "B2SUMS" not in names(store, "runs/one/")
    assert run(monkeypatch, capfd, *fit)[0] == 0
    left = names(store, "runs/one/")
    assert "smoothed.csv" not in left


def test_a_run_with_a_file_of_somebody_is_not_replaced(store, monkeypatch, capfd, mcap):
    fit = ("fit", mcap, *ROBOT, "-o", "s3://field/runs/one", "--plots", "none")
    assert run(monkeypatch, capfd, *fit)[0] == 0
    store.client.put_object(Bucket="field", Key="runs/one/notes.txt", Body=b"of a person")
    before = {name: content(store, name) for name in names(store)}
    status, said = run(monkeypatch, capfd, *fit, "--overwrite")
    assert status == 1
    assert "s3://field/runs/one: holds notes.txt" in said
    assert {name: content(store, name) for name in names(store)} == before


@pytest.mark.parametrize(
    "arguments",
    [("calibrate", "one", "-o", "PLACE"), ("calibrate", "one", "--plot", "PLACE"),
     ("fit", "a.mcap", "--config", "PLACE"), ("simulate", "-o", "PLACE")],
)  # fmt: skip
def test_where_an_address_is_not_taken_it_is_refused_without_its_secrets(monkeypatch, capfd, tmp_path, arguments):
    monkeypatch.chdir(tmp_path)
    place = f"s3://key:{SECRET}@field/one.json"
    status, said = run(monkeypatch, capfd, *(place if one == "PLACE" else one for one in arguments))
    assert status == 2
    assert "s3://field/one.json: is an address; name a place on disk" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("there", "place", "why"),
    [("season/a.mcap", "s3://field/season", "not a run directory"), ("one", "s3://field/one", "a file is there"),
     ("x", "s3://none/one", "cannot be written"), ("x", "https://host/one", "not written to a web server"),
     ("runs/one/run.json", "s3://field/runs/one", "not a run directory")],
)  # fmt: skip
def test_a_place_that_cannot_be_written_is_refused_before_the_log_is_read(
    store, monkeypatch, capfd, there, place, why
):  # fmt: skip
    store.client.put_object(Bucket="field", Key=there, Body=b"of a person")
    status, said = run(monkeypatch, capfd, "fit", "none.mcap", *ROBOT, "-o", place)
    assert status == 1
    assert why in said
    assert len(said.splitlines()) == 1
    assert names(store) == [there]
    assert content(store, there) == b"of a person"


def test_the_run_of_another_recording_is_not_replaced(store, monkeypatch, capfd, mcap, bag):
    assert run(monkeypatch, capfd, "fit", mcap, *ROBOT, "-o", "s3://field/one", "--plots", "none")[0] == 0
    before = content(store, "one/run.json")
    status, said = run(monkeypatch, capfd, "fit", bag, *ROBOT, "-o", "s3://field/one", "--plots", "none")
    assert status == 1
    assert "holds the run of another recording" in said
    assert content(store, "one/run.json") == before
    assert run(monkeypatch, capfd, "fit", bag, *ROBOT, "-o", "s3://field/one", "--plots", "none", "--overwrite")[0] == 0
    assert content(store, "one/run.json") != before


def test_a_batch_at_an_address_is_that_on_disk_and_is_continued(store, tmp_path, monkeypatch, capfd, mcap, bag):
    monkeypatch.setattr("icrtool.fleet.batch.process_apart", in_this_process)
    (tmp_path / "season").mkdir()
    for log in (mcap, bag):
        shutil.copy(log, tmp_path / "season")
        store.client.upload_file(str(log), "field", f"season/{log.name}")
    lean = ("--plots", "none", "--no-ladder", "-j", "1")
    command = ("batch", "s3://field/season", *ROBOT, "-o", "s3://field/out", *lean)
    status, said = run(monkeypatch, capfd, *command)
    assert status == 0, said
    assert "fleet.csv" in said
    assert run(monkeypatch, capfd, "batch", "season", *ROBOT, "-o", "out", *lean)[0] == 0
    written = {str(file.relative_to(tmp_path / "out")) for file in (tmp_path / "out").rglob("*") if file.is_file()}
    assert set(names(store, "out/")) == written
    tables = content(store, "out/fleet.csv"), (tmp_path / "out/fleet.csv").read_bytes()
    theirs, ours = ([line.split(b",")[6:-3] for line in table.splitlines()] for table in tables)
    assert theirs == ours
    links = [f"runs/{log.stem}/report.html".encode() for log in (mcap, bag)]
    assert all(link in content(store, "out/report.html") for link in links)
    calibrations = [json.loads(text)["calibrations"] for text in (content(store, "out/fleet.json"),
                    (tmp_path / "out/fleet.json").read_bytes())]  # fmt: skip
    assert [{**one, "key": ""} for one in calibrations[0]] == [{**one, "key": ""} for one in calibrations[1]]

    store.client.delete_object(Bucket="field", Key=f"out/runs/{bag.stem}/B2SUMS")
    status, said = run(monkeypatch, capfd, *command, "--json")
    assert status == 0, said
    document = json.loads(said)
    assert {one["log"]: one["this_time"] for one in document["logs"]} == {mcap.name: "skipped", bag.name: "processed"}
    assert document["output"] == "s3://field/out"
    assert set(names(store, "out/")) == written
    assert not [name for name in names(store) if SECRET.encode() in content(store, name)]


def test_names_in_a_bucket_lead_to_no_place_outside_the_temporary_folder(store, tmp_path):
    for name in ("one/../../../escaped.json", "one//etc/x.json", "one/a/", "one/b.json"):
        store.client.put_object(Bucket="field", Key=name, Body=b"{}")
    with folder_on_disk(UrlPath("s3://field/one")) as folder:
        found = [str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()]
        assert found == ["b.json"]
    store.client.put_object(Bucket="field", Key="one/b.json/c", Body=b"{}")
    with pytest.raises(OutputError, match="cannot be written"), folder_on_disk(UrlPath("s3://field/one")):
        pass
    assert not list(tmp_path.rglob("escaped.json"))


def test_ctrl_c_while_a_run_is_uploaded_leaves_nothing_that_counts_and_no_temporary_file(store, tmp_path, mcap):
    command = ("fit", str(mcap), *ROBOT, "-o", "s3://field/runs/one", "--plots", "none")
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "icrtool", *command], cwd=tmp_path, stderr=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(tmp_path / "temporary")},
    )  # fmt: skip
    begun = store.sent
    while store.sent < begun + PART_BYTES:
        assert process.poll() is None
        time.sleep(0.005)
    with store.lock:  # nothing passes
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
    process.stderr.close()
    assert "B2SUMS" not in names(store, "runs/one/")


def fit_command(log: Path) -> tuple[object, ...]:
    return ("fit", log, *ROBOT, "-o", "s3://field/runs/one", "--plots", "none")


def fit_apart(log: Path) -> int:
    """Fit the log in a process of its own, to the same address; return the exit status."""
    command = [sys.executable, "-P", "-m", "icrtool", *map(str, fit_command(log)), "--smooth", "-q"]
    return subprocess.run(command, check=False, capture_output=True, timeout=120).returncode


@pytest.mark.parametrize("moment", ["upload", "_check_claim"])
def test_of_two_commands_that_write_to_one_address_one_ends_with_an_error(store, monkeypatch, capfd, mcap, moment):
    """The other command writes all of its run, or claims the place, between two steps of this one."""
    step, others = getattr(remote_place._Store, moment), []

    def after_the_other(self, *given):
        if not others:
            others.append(0)
            if moment == "upload":
                others[0] = fit_apart(mcap)
            else:
                self.put(b"of another command", remote_place._CLAIM)
        return step(self, *given)

    monkeypatch.setattr(remote_place._Store, moment, after_the_other)
    status, said = run(monkeypatch, capfd, *fit_command(mcap))
    (line,) = [one for one in said.splitlines() if one.startswith("Error: ")]
    assert (status, others) == (1, [0])
    assert "s3://field/runs/one: another command" in line
    if moment == "upload":
        assert "smoothed.csv" in names(store, "runs/one/")
        assert icrtool.open_run("s3://field/runs/one").document.request.smooth
        assert ".icrtool-writer" not in names(store, "runs/one/")
    else:
        # nothing was changed before the claim was looked at, and the claim of the other command stays
        assert names(store, "runs/one/") == [".icrtool-writer"]


@pytest.mark.parametrize("group", [0, 1, 2])
def test_a_command_that_writes_while_another_uploads_changes_nothing_and_the_run_is_whole(
    store, monkeypatch, capfd, mcap, group
):
    """The other command begins and ends before each group of files of this one; it states another living process."""
    each, others, calls = remote_place._Store._ask_for_each, [], []
    other = f"{writer_id().partition('-')[0]}-{os.getppid()}-0123abcd"

    def between(self, request, files):
        if isinstance(request, functools.partial):
            calls.append(0)
            if len(calls) == group + 1:
                with monkeypatch.context() as patch:
                    patch.setattr(remote_place, "writer_id", lambda: other)
                    others.append(run(patch, capfd, *fit_command(mcap), "--smooth", "-q")[0])
        return each(self, request, files)

    monkeypatch.setattr(remote_place._Store, "_ask_for_each", between)
    status, said = run(monkeypatch, capfd, *fit_command(mcap))
    assert status == 0, said
    assert others == [1]
    assert ".icrtool-writer" not in names(store, "runs/one/")
    found = icrtool.open_run("s3://field/runs/one")  # the sums of its files fit
    assert not found.document.request.smooth
    for line in content(store, "runs/one/B2SUMS").decode().splitlines():
        digest, _, name = line.partition("  ")
        assert hashlib.blake2b(content(store, f"runs/one/{name}")).hexdigest() == digest


def test_a_claim_of_a_living_command_is_named_and_one_of_a_dead_command_is_replaced(store, monkeypatch, capfd, mcap):
    here = writer_id().partition("-")[0]
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    now = int(time.time())
    claims = {
        f"{here}-{os.getppid()}-0123abcd {now - 600}": "has been writing there for 10 min",
        f"0123abcd-1-0123abcd {now - 60}": "has been writing there for 1 min",
        f"{here}-{gone.pid}-0123abcd {now}": "",
        f"0123abcd-1-0123abcd {now - 7200}": "",
        "\x1b[2J": "",
        "9" * 5000: "",
    }
    for claim, words in claims.items():
        store.client.put_object(Bucket="field", Key="runs/one/.icrtool-writer", Body=claim.encode())
        status, said = run(monkeypatch, capfd, *fit_command(mcap), "--overwrite")
        assert status == bool(words), said
        if words:
            assert f"s3://field/runs/one: another command {words}; its results stay" in said
            assert content(store, "runs/one/.icrtool-writer") == claim.encode()
        else:
            assert ".icrtool-writer" not in names(store, "runs/one/")


@pytest.fixture(params=["refused", "ignored"])
def conditions(request, monkeypatch):
    """A store that refuses conditional writes, or writes whatever their condition is."""
    import s3fs

    if request.param == "kept":
        return request.param

    put = s3fs.S3FileSystem._pipe_file

    async def without(self, path, data, *given, mode="overwrite", **named):
        if mode == "create" and request.param == "refused":
            raise OSError(errno.ENOSYS, "A header you provided implies functionality that is not implemented.")
        return await put(self, path, data, *given, **named)

    monkeypatch.setattr(s3fs.S3FileSystem, "_pipe_file", without)
    return request.param


@pytest.mark.usefixtures("conditions")
def test_a_store_without_conditional_writes_is_written_all_the_same(store, monkeypatch, capfd, mcap):
    status, said = run(monkeypatch, capfd, *fit_command(mcap))
    assert status == 0, said
    config = icrtool.load_config(robot=ROBOT[1])
    expected = icrtool.fit(icrtool.read_log(mcap, config), config)
    assert len(icrtool.open_run("s3://field/runs/one").states) == len(expected.states)
    assert not [name for name in names(store) if ".icrtool-writer" in name]


def claim_of(place: str, uploads: list[str], is_conditional: bool) -> Iterator[str]:
    """Claim a place step by step: a step is a request; `uploads` gets the place where the claim succeeds."""
    claiming = remote_place._Store(UrlPath(place))
    claiming._is_conditional = is_conditional
    turns, steps = queue.Queue(), queue.Queue()

    def in_turn(request):
        steps.put("request")
        turns.get()
        return remote_place._Store._ask(claiming, request)

    def work():
        turns.get()
        try:
            claiming._take_claim()
            uploads.append(place)
        except OutputError:
            pass
        steps.put("end")

    claiming._ask = in_turn
    threading.Thread(target=work, daemon=True).start()
    while True:
        turns.put(None)
        if steps.get() == "end":
            return
        yield place


@pytest.mark.parametrize("conditions", ["kept", "refused", "ignored"], indirect=True)
@pytest.mark.parametrize("seed", range(5))
def test_of_two_commands_that_claim_a_place_in_the_same_moment_one_at_most_uploads(
    store, conditions, monkeypatch, seed
):
    """The requests of both come in any order."""
    monkeypatch.setattr(remote_place, "_is_abandoned", lambda claim: not claim)
    rng, uploads = random.Random(seed), []
    both = [claim_of("s3://field/runs/one", uploads, conditions == "kept") for _ in range(2)]
    while both:
        turn = rng.choice(both)
        if next(turn, None) is None:
            both.remove(turn)
    assert len(uploads) <= 1
    assert uploads or conditions != "kept"
    assert (".icrtool-writer" in names(store, "runs/one/")) is bool(uploads)
    assert not [name for name in names(store, "runs/one/") if name.startswith(".icrtool-writer-")]


@pytest.mark.usefixtures("conditions")
@pytest.mark.parametrize("conditions", ["refused"], indirect=True)
def test_an_announcement_of_a_dead_command_is_removed_and_that_of_a_living_one_is_named(
    store, monkeypatch, capfd, mcap
):
    now = int(time.time())
    old, new = f".icrtool-writer-0123abcd-1-0123abcd-{now - 7200}", f".icrtool-writer-0123abcd-1-0123abcd-{now - 60}"
    store.client.put_object(Bucket="field", Key=f"runs/one/{old}", Body=b"icrtool")
    assert run(monkeypatch, capfd, *fit_command(mcap))[0] == 0
    assert old not in names(store, "runs/one/")
    store.client.put_object(Bucket="field", Key=f"runs/one/{new}", Body=b"icrtool")
    status, said = run(monkeypatch, capfd, *fit_command(mcap), "--smooth", "--overwrite")
    assert status == 1
    assert "another command has been writing there for 1 min" in said
    assert "smoothed.csv" not in names(store, "runs/one/")


def test_a_claim_that_another_command_took_after_an_hour_is_seen_between_files(store, monkeypatch, capfd, mcap):
    put, seen = remote_place._Store._put_file, []

    def after_the_other(self, folder, claim, name):
        if not seen:
            self.put(b"of another command", remote_place._CLAIM)
            self._checked_s = 0.0
        seen.append(name)
        return put(self, folder, claim, name)

    monkeypatch.setattr(remote_place._Store, "_put_file", after_the_other)
    status, said = run(monkeypatch, capfd, *fit_command(mcap))
    assert status == 1
    assert "another command began to write there" in said
    assert "states.csv" not in names(store, "runs/one/")
