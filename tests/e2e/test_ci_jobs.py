"""The CI jobs that docs/ci.md shows, run as they stand there: from Python alone to a verdict, in a fresh environment.

The action, the GitLab template and the Dockerfile call scripts/container-setup.sh; it runs here once, without privilege
and with the files alone that the image would have.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from support.jobs import Action, in_bash, yaml_of

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "ci.md").read_text(encoding="utf-8")
STEP, INCLUDE, WORKFLOW = [yaml_of(block)[0] for block in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)]
SHELL, DOCKER = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
HEADER, TEMPLATE = yaml_of((ROOT / ".gitlab" / "icrtool-job.yml").read_text(encoding="utf-8"))

COUNTED = """
import sys
from numba.core import event
compiled = []
class Listener(event.Listener):
    def on_start(self, event):
        compiled.append(event.data["dispatcher"].py_func.__qualname__)
    def on_end(self, event):
        pass
event.register("numba:compile", Listener())
try:
    {call}
finally:
    print(len(compiled), *compiled, file=sys.stderr)
"""
"""A call that counts what is compiled while it runs."""
COMMAND = COUNTED.replace("{call}", "from icrtool.cli import main; main()")
KERNEL = COUNTED.replace(
    "{call}", "import numpy; from icrtool.kernels.kinematics import lag; lag(numpy.zeros(2), numpy.zeros(1))"
)


def set_writable(folder: Path, *, writable: bool) -> None:
    for path in [folder, *folder.rglob("*")]:
        if not path.is_symlink():
            path.chmod(path.stat().st_mode | 0o200 if writable else path.stat().st_mode & ~0o222)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, short_logs: Path) -> Path:
    """A repository with a log and the checkout of icrtool in it: what an image is built of, and the action."""
    place = tmp_path_factory.mktemp("repository")
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert ignored[0] == "*"
    for name in [line[1:] for line in ignored if line.startswith("!")] + [".github"]:
        found, copied = ROOT / name, place / "icrtool" / name
        copied.parent.mkdir(exist_ok=True)
        if found.is_dir():
            shutil.copytree(found, copied, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(found, copied)
    set_writable(place / "icrtool", writable=False)
    (place / "logs").mkdir()
    shutil.copy(short_logs / "field.mcap", place / "logs" / "field.mcap")
    return place


def action(place: Path, temp: Path, given: dict[str, Any], **more: Any) -> Action:
    """Return the action of a step."""
    return Action(place / "icrtool" / ".github" / "actions" / "icrtool" / "action.yml", given, temp, **more)


@pytest.fixture(scope="module")
def job(place: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Action, dict[str, str]]:
    """The step of the page, and its outputs."""
    [step] = STEP
    assert step["uses"] == "./icrtool/.github/actions/icrtool"
    ran = action(place, tmp_path_factory.mktemp("temp"), step["with"])
    with pytest.MonkeyPatch.context() as patch:
        if (uv := Path(sys.executable).with_name("uv")).exists():
            tools = tmp_path_factory.mktemp("tools")
            (tools / "uv").symlink_to(uv)
            patch.setenv("PATH", f"{os.environ['PATH']}:{tools}")
        outputs = ran.run(place)
    if "connection broken by" in "".join(ran.said):
        pytest.skip("pip cannot fetch packages here")
    return ran, outputs


@pytest.fixture(scope="module")
def activate(job: tuple[Action, dict[str, str]]) -> Path:
    """What a shell reads to have the environment that the job made."""
    return job[0].temp / "icrtool" / "bin" / "activate"


def test_the_step_of_the_page_gives_verdict_summary_and_page(place: Path, job: tuple[Action, dict[str, str]]) -> None:
    ran, outputs = job
    assert ran.status == [0] * 4, ran.said
    assert outputs["verdict"] == "met"
    assert "All acceptance limits are met" in (place / outputs["summary"]).read_text(encoding="utf-8")
    assert "field.mcap" in (ran.temp / "page.md").read_text(encoding="utf-8")
    found = {path.relative_to(place).as_posix() for one in ran.uploaded["path"].split() for path in place.glob(one)}
    results = "icrtool-results"
    assert {f"{results}/{name}" for name in ("report.html", "fleet.json", "summary.md", "gates.xml")} <= found
    assert f"{results}/runs/field/report.html" in found


def test_a_limit_that_is_not_met_fails_the_job_that_found_its_environment_in_the_cache(
    place: Path, job: tuple[Action, dict[str, str]]
) -> None:
    ran, _ = job
    [step] = [one for one in WORKFLOW["jobs"]["icrtool"]["steps"] if "submodules" not in one["with"]]
    shutil.copytree(place / "icrtool-results", place / step["with"]["baseline"])
    gates = step["with"]["gates"] + "recommended.p95@5m <= 0.01\n"
    lean = "--plots none --no-page"
    again = action(place, ran.temp, step["with"] | {"gates": gates, "options": lean}, cached=True)
    outputs = again.run(place)
    assert again.status == [0, 0, 1]
    assert outputs["verdict"] == "not-met"
    cases = ET.parse(place / "icrtool-results" / "gates.xml").getroot().iter("testcase")
    assert [case.find("failure") is not None for case in cases] == [False, False, True]


def test_a_log_that_cannot_be_used_is_another_verdict(place: Path, job: tuple[Action, dict[str, str]]) -> None:
    again = action(place, job[0].temp, {"logs": "gone.mcap", "results": "none"}, cached=True)
    assert again.run(place)["verdict"] == "failed"
    assert again.status == [0, 0, 1]


def test_commands_compile_nothing_from_a_read_only_environment(place: Path, activate: Path) -> None:
    cache = activate.parents[1] / "kernels"
    held = sorted(cache.rglob("*"))
    set_writable(cache, writable=False)
    try:
        command = "dropout-report logs/field.mcap --robot husky-a200 -o run --plots none --no-page -q"
        counted = in_bash(f". {activate} && exec python -c '{COMMAND}' {command}", place, {})
        assert counted.returncode == 0, counted.stderr
        assert counted.stderr.splitlines()[-1] == "0"
        refused = in_bash(f". {activate} && icrtool cache warm", place, {})
        other = in_bash(f". {activate} && env -u NUMBA_CPU_NAME python -c '{KERNEL}'", place, {})
    finally:
        set_writable(cache, writable=True)
    assert (refused.returncode, refused.stderr.count("\n")) == (1, 1)
    assert other.returncode == 0
    assert "lag" in other.stderr.split()[1:], "compiled in memory, for this processor"
    assert sorted(cache.rglob("*")) == held


def gitlab_job(place: Path, inputs: dict[str, str], before: str = "") -> Any:
    """Run the job of the template with some inputs, in one shell as a runner does."""
    declared = HEADER["spec"]["inputs"]
    assert set(inputs) <= set(declared)
    values = {key: inputs.get(key, one.get("default")) for key, one in declared.items()}
    assert None not in values.values()
    job = TEMPLATE["icrtool"]
    variables = {
        key: re.sub(r"\$\[\[ inputs\.(\w+) \]\]", lambda found: values[found[1]], value)
        for key, value in job["variables"].items()
    }
    return in_bash("\n".join([before, *job["before_script"], *job["script"]]), place, variables)


def test_the_gitlab_job_of_the_page_runs_in_an_image_with_icrtool(place: Path, activate: Path) -> None:
    [include] = INCLUDE["include"]
    inputs = include["inputs"]
    done = gitlab_job(place, inputs, f". {activate}")
    assert done.returncode == 0, done.stderr
    for pattern in [*TEMPLATE["icrtool"]["artifacts"]["paths"], TEMPLATE["icrtool"]["artifacts"]["reports"]["junit"]]:
        assert list(place.glob(pattern)), pattern
    cases = ET.parse(place / "icrtool-results" / "gates.xml").getroot().iter("testcase")
    assert [case.get("name") for case in cases] == [inputs["gates"]]


def test_the_gitlab_job_makes_the_environment_once_for_a_checkout(place: Path, activate: Path) -> None:
    # The script that makes it ran once already: here another one stands for it.
    checkout = place / "other"
    (checkout / "scripts").mkdir(parents=True)
    script = checkout / "scripts" / "container-setup.sh"
    script.write_text(f'#!/bin/sh\necho made >>"$1.log"; mkdir -p "$1/bin"; echo ". {activate}" >"$1/bin/activate"\n')
    script.chmod(0o755)
    commit = "-c user.name=x -c user.email=x commit -q --allow-empty -m x"
    assert in_bash(f"git init -q && git {commit}", checkout, {}).returncode == 0
    inputs = {"logs": "gone.mcap", "checkout": "other"}
    counts = []
    for change in ("true", "true", f"git {commit}"):
        assert in_bash(change, checkout, {}).returncode == 0
        assert gitlab_job(place, inputs).returncode == 1
        counts.append((place / ".icrtool.log").read_text().count("made"))
    assert counts == [1, 1, 2]


def test_the_lines_for_a_shell_end_in_a_verdict(place: Path, activate: Path) -> None:
    made, activated, command = SHELL.splitlines()
    assert made == "icrtool/scripts/container-setup.sh .icrtool", "which the action has run"
    assert activated == ". .icrtool/bin/activate"
    lines = f". {activate}\n{command} --no-page --plots none"
    done = in_bash(lines, place, {})
    assert done.returncode == 0, done.stderr
    assert json.loads((place / "results" / "fleet.json").read_bytes())["logs"][0]["verdicts"][0]["passed"]


PYTHON = """#!/bin/sh
echo "$@" >>"$(dirname "$0")/../../asked"
case "$*" in
-c*) ;;
*venv*) mkdir -p "$3/bin"; cp "$0" "$3/bin/python"; echo "VIRTUAL_ENV=$PWD/$3" >"$3/bin/activate" ;;
esac
"""


def asked_of_python(place: Path, folder: Path, uv: str, extras: str = "") -> list[str]:
    """Return what the script asks of Python where uv is this script, or is not there."""
    tools = folder / "own" / "bin"
    tools.mkdir(parents=True)
    for name, text in {"python3": PYTHON, "icrtool": "#!/bin/sh\n", "uv": uv}.items():
        if text:
            (tools / name).write_text(text)
            (tools / name).chmod(0o755)
    script = f"PATH={tools}:/usr/bin:/bin {place}/icrtool/scripts/container-setup.sh made {extras}"
    done = in_bash(script, folder, {})
    assert done.returncode == 0, done.stderr
    return [line for line in (folder / "asked").read_text().splitlines() if not line.startswith("-c")]


@pytest.mark.parametrize("uv", ["", "#!/bin/sh\nexit 1\n"], ids=["without uv", "uv cannot"])
def test_pip_installs_by_hash_what_uv_does_not(place: Path, tmp_path: Path, uv: str) -> None:
    asked = asked_of_python(place, tmp_path, uv)
    assert asked[0] == "-m venv made" + (" --without-pip" if uv else "")
    assert asked.count("-m ensurepip") == bool(uv)
    installed = [line for line in asked if line.startswith("-m pip")]
    pip = "-m pip --disable-pip-version-check install --quiet --no-compile --no-deps"
    assert re.fullmatch(rf"{pip} --require-hashes -r \S+/pinned.txt", installed[0])
    assert installed[1:] == [f"{pip} --no-build-isolation {place}/icrtool"]
    assert "-m ensurepip" not in asked[asked.index(installed[0]) :]


def test_pip_is_there_to_resolve_extras_that_uv_installs(place: Path, tmp_path: Path) -> None:
    asked = asked_of_python(place, tmp_path, "#!/bin/sh\n", "cloud")
    resolve = f"{place}/icrtool/scripts/pinned_requirements.py cloud"
    assert asked == ["-m venv made --without-pip", "-m ensurepip", resolve]


def test_pins_of_a_package_are_those_of_all_it_needs() -> None:
    command = "python3 scripts/pinned_requirements.py --only markdown-it-py"
    done = in_bash(f"python3 -m pip --version >&2 || exit 9; {command}", ROOT, {})
    if done.returncode == 9 or "connection broken by" in done.stderr:
        pytest.skip("pip is not here or cannot fetch packages")
    assert done.returncode == 0, done.stderr
    names = re.findall(r"^([\w-]+)==\S+.* \\\n +--hash=sha256:", done.stdout, re.MULTILINE)
    assert names == ["markdown-it-py", "mdurl"]


def test_the_image_is_made_by_the_script_alone_and_has_its_environment(activate: Path) -> None:
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    assert re.findall(r"^RUN (.*)$", text, re.MULTILINE) == ["/icrtool/scripts/container-setup.sh /opt/icrtool $EXTRAS"]
    assert re.search(r"^USER 10001:10001$", text, re.MULTILINE)
    [variables] = re.findall(r"^ENV (.*)$", text, re.MULTILINE)
    here = (
        in_bash(f". {activate} && env", ROOT, {}).stdout.replace(str(activate.parents[1]), "/opt/icrtool").splitlines()
    )
    for one in variables.split():
        assert any(line.startswith(one.replace("$PATH", "")) for line in here) or one == "HOME=/tmp", one
    assert "docker build -t icrtool icrtool" in DOCKER
