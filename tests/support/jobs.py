"""Run the steps of a GitHub action, as a runner does, with what they are given."""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

EXPRESSION = re.compile(r"\$\{\{ *([\w.-]+) *\}\}")
CONDITION = re.compile(r"([\w.-]+) *!= *'([^']*)'")


def yaml_of(text: str) -> list[Any]:
    """Return the documents of a YAML text."""
    return list(YAML(typ="safe").load_all(text))


@dataclass
class Action:
    """A composite action under way.

    Attributes
    ----------
    path : of its action.yml
    given : its inputs
    temp : folder that the steps of a job share
    cached : whether what its cache holds is there already
    outputs : of its steps, by ``steps.ID.outputs.NAME``
    uploaded : what it gave ``actions/upload-artifact``, resolved
    status : of each script that ran; said : what it wrote to standard error
    """

    path: Path
    given: dict[str, str]
    temp: Path
    cached: bool = False
    outputs: dict[str, str] = field(default_factory=dict)
    uploaded: dict[str, str] = field(default_factory=dict)
    status: list[int] = field(default_factory=list)
    said: list[str] = field(default_factory=list)

    def run(self, folder: Path) -> dict[str, str]:
        """Run all steps in `folder`; return the outputs of the action."""
        [action] = yaml_of(self.path.read_text(encoding="utf-8"))
        assert set(self.given) <= set(action["inputs"])
        known = {f"inputs.{key}": one.get("default", "") for key, one in action["inputs"].items()}
        self.outputs = known | {f"inputs.{key}": str(value) for key, value in self.given.items()}
        self.outputs |= {"runner.temp": str(self.temp), "steps.cache.outputs.cache-hit": str(self.cached).lower()}
        missing = [key for key, one in action["inputs"].items() if one.get("required") and key not in self.given]
        assert not missing
        for step in action["runs"]["steps"]:
            if "if" not in step or self._holds(step["if"]):
                self._step(step, folder)
        return {key: self._filled(one["value"]) for key, one in action["outputs"].items()}

    def _holds(self, condition: str) -> bool:
        found = CONDITION.fullmatch(condition)
        assert found, condition
        return self.outputs[found[1]] != found[2]

    def _filled(self, text: str) -> str:
        assert "${{" not in EXPRESSION.sub("", text), text
        return EXPRESSION.sub(lambda found: self.outputs[found[1]], text)

    def _step(self, step: dict[str, Any], folder: Path) -> None:
        if "uses" in step:
            assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", step["uses"])
            if "upload-artifact" in step["uses"]:
                self.uploaded = {key: self._filled(value) for key, value in step["with"].items()}
            return
        assert step["shell"] == "bash"
        assert "${{" not in step["run"], "an expression in a script runs what it holds"
        output = self.temp / "output"
        output.write_text("", encoding="utf-8")
        environment = {
            "GITHUB_OUTPUT": str(output), "GITHUB_STEP_SUMMARY": str(self.temp / "page.md"), "RUNNER_OS": "Linux",
            "RUNNER_ARCH": "X64", "RUNNER_TEMP": str(self.temp), "GITHUB_ACTION_PATH": str(self.path.parent),
        }  # fmt: skip
        environment |= {key: self._filled(value) for key, value in step.get("env", {}).items()}
        done = in_bash(step["run"], folder, environment)
        self.status.append(done.returncode)
        self.said.append(done.stderr)
        for line in output.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition("=")
            self.outputs[f"steps.{step['id']}.outputs.{key}"] = value


def without_privilege() -> None:
    """Have the process to be started obey permissions, also where root runs the tests."""
    drop_from_bounding_set, capabilities = 24, 41
    if os.geteuid() == 0:
        for one in range(capabilities):
            ctypes.CDLL(None).prctl(drop_from_bounding_set, one, 0, 0, 0)


def in_bash(script: str, folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a script as runners do, without privilege and without what the tests' own Python was told."""
    own = ("NUMBA_", "PYTEST_", "PYTHON", "VIRTUAL_ENV")
    given = {key: value for key, value in os.environ.items() if not key.startswith(own)}
    # python3 is the one that the tests' environment was made with
    given["PATH"] = f"{sys.base_prefix}/bin:{given['PATH']}"
    return subprocess.run(
        ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", script], cwd=folder, env=given | environment,
        capture_output=True, text=True, check=False, preexec_fn=without_privilege,
    )  # fmt: skip
