from __future__ import annotations

import sys
from pathlib import Path

import pytest

from icrtool.errors import ConfigError
from icrtool.fleet.recordings import About, about_recording, read_manifest


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    for name in ("mon/a.mcap", "mon/b.mcap", "tue/c.mcap", "odd[1].mcap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    return tmp_path


def test_csv_and_toml_state_the_same(logs: Path) -> None:
    (logs / "m.csv").write_text(
        "log,robot,config,group,tags\nmon/*.mcap,husky-a200,,grass,wet; dark\ntue,,t.toml,gravel,\n"
    )
    (logs / "m.toml").write_text(
        '[[logs]]\nlog = "mon/*.mcap"\nrobot = "husky-a200"\ngroup = "grass"\ntags = ["wet", "dark"]\n'
        '[[logs]]\nlog = "tue"\nconfig = "t.toml"\ngroup = "gravel"\n'
    )
    assert read_manifest(logs / "m.csv") == read_manifest(logs / "m.toml")
    entries = read_manifest(logs / "m.csv")
    assert about_recording(logs / "mon" / "b.mcap", entries) == About("husky-a200", None, "grass", ("wet", "dark"))
    assert about_recording(logs / "tue" / "c.mcap", entries) == About("", logs / "t.toml", "gravel", ())


def test_a_later_line_refines_an_earlier_one(logs: Path) -> None:
    (logs / "m.csv").write_text("log,robot,group,tags\n**/*.mcap,jackal,grass,season\nmon/b.mcap,,ice,cold\n")
    entries = read_manifest(logs / "m.csv")
    assert about_recording(logs / "mon" / "b.mcap", entries) == About("jackal", None, "ice", ("season", "cold"))
    assert about_recording(logs / "mon" / "a.mcap", entries) == About("jackal", None, "grass", ("season",))


def test_a_name_with_brackets_is_a_name_where_it_is_there(logs: Path) -> None:
    (logs / "m.csv").write_text("log\nodd[1].mcap\n")
    assert read_manifest(logs / "m.csv")[0].places == (logs / "odd[1].mcap",)


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("m.csv", "", "empty|log"),
        ("m.csv", "file\na.mcap\n", "column log"),
        ("m.csv", "log,robto\nmon,x\n", "robto"),
        ("m.csv", "log,robot\nmon\n", "m.csv:2"),
        ("m.csv", "log\nnowhere/*.mcap\n", "matches no file or folder"),
        ("m.csv", 'log\n"mon', "not a manifest"),
        ("m.toml", "logs = 3", r"\[\[logs\]\]"),
        ("m.toml", "[[logs]]\nlog = 3", "log"),
        ("m.toml", "[[logs]]\nlog = 'mon'\ntags = [3]", "log"),
        ("m.toml", "[robot]\nname = 'x'", r"\[\[logs\]\]"),
        ("m.toml", "a = " + "[" * 5000, "not a manifest"),
        ("m.toml", "not toml", "not a manifest"),
    ],
)
def test_what_is_no_manifest_is_one_line(logs: Path, name: str, content: str, what: str) -> None:
    (logs / name).write_text(content)
    with pytest.raises(ConfigError, match=what) as error:
        read_manifest(logs / name)
    assert "\n" not in str(error.value)


RECURSES = pytest.mark.skipif(sys.version_info >= (3, 14), reason="pathlib matches it since Python 3.14")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        pytest.param("a.csv", "log\n" + "**/" * 2000 + "*\n", marks=RECURSES),
        ("a.csv", "log\n" + "x" * 5000 + "\n"),
        ("a.csv", "log\n" + "x" * 11_000_000),
        ("a.toml", ".".join(["a"] * 20_000) + " = 1"),
        ("a.toml", "logs = " + "[" * 50_000),
    ],
    ids=["pattern", "name", "size", "key", "values"],
)
def test_a_manifest_made_to_exhaust_is_refused(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigError) as err:
        read_manifest(tmp_path / name)
    assert len(str(err.value).splitlines()) == 1


def test_an_edited_manifest_is_refused_in_one_line_or_read(logs: Path) -> None:
    line = {"log": "mon", "robot": "jackal", "config": "t.toml", "group": "grass", "tags": ["wet"]}
    wrong = ["1", "1.5", "true", "1979-05-27", "[[]]", "{a = 1}", '"\\u001b[2J"', '""', "[1]", "inf", '"a\\u0000b"']
    read, refusals = 0, []
    for key in line:
        for value in wrong:
            texts = {name: value if name == key else str(text) for name, text in line.items()}
            rows = [f"{name} = {text if name in (key, 'tags') else repr(text)}" for name, text in texts.items()]
            (logs / "m.toml").write_text("\n".join(["[[logs]]", *rows]))
            (logs / "m.csv").write_text(f"{','.join(line)}\n{','.join(str(text) for text in texts.values())}\n")
            for name in ("m.toml", "m.csv"):
                try:
                    about_recording(logs / "mon" / "a.mcap", read_manifest(logs / name))
                    read += 1
                except ConfigError as err:
                    refusals.append(str(err))
    assert read
    assert not [text for text in refusals if not text.isprintable()]
