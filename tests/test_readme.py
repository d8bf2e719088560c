"""What the README says: its commands exist, its links lead somewhere, its numbers hold."""

import csv
import importlib.util
import re
import shlex
from pathlib import Path

import pytest

import coursekit as ck
from coursekit import cli
from coursekit.budget.handover import REFERENCE
from tools.build_notebooks import find, read
from tools.core_time import MOST, MOST_OF_ALL, core_minutes

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
CODE = re.findall(r"`([^`\n]+)`", TEXT) + [
    line
    for block in re.findall(r"```\w*\n(.*?)```", TEXT, re.DOTALL)
    for line in block.splitlines()
]


def course_commands() -> set[str]:
    source = (ROOT / "course.py").read_text(encoding="utf-8")
    (table,) = re.findall(r"commands = \{(.*)\}", source)
    return set(re.findall(r'"(\w+)":', table))


def test_every_command_of_course_py_is_described_and_exists() -> None:
    said = {m.group(1) for line in CODE if (m := re.match(r"py(?:thon3)? course\.py (\w+)", line))}
    assert said == course_commands()


@pytest.mark.parametrize(
    "line", [line for line in CODE if re.match(r"(\.venv/bin/)?coursekit \w", line)]
)
def test_commands_of_coursekit_are_understood(line: str) -> None:
    words = shlex.split(line)[1:]
    if words in (["submit"], ["grade"]):  # named in passing
        return
    cli._parser().parse_args(words)


def test_each_subcommand_is_in_the_readme(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    commands = re.findall(r"^    ([\w-]+)\s", capsys.readouterr().out, re.MULTILINE)
    assert {"calibrate", "hand-eye", "record", "board", "submit", "grade", "doctor"} <= set(
        commands
    )
    for command in commands:
        assert f"coursekit {command}" in TEXT, command


def test_the_places_to_change_something_exist() -> None:
    table = TEXT.partition("| you want to change |")[2].partition("\n\n")[0]
    places = re.findall(r"`([\w/]+\.(?:py|toml))`", table)
    assert len(places) > 20
    assert [place for place in places if not (ROOT / "coursekit" / place).is_file()] == []


def test_functions_that_it_names_exist() -> None:
    names = {m for line in CODE for m in re.findall(r"\bck\.([\w.]+)\(", line)}
    assert {"open_camera", "progress"} <= names
    for name in names:
        found = ck
        for part in name.split("."):
            found = getattr(found, part)
        assert callable(found)


def test_modules_that_it_runs_exist() -> None:
    for line in CODE:
        if m := re.match(r"\.venv/bin/python (?:-m (\S+)|(\S+\.py))", line):
            module, script = m.groups()
            assert importlib.util.find_spec(module) if module else (ROOT / script).is_file()


def test_files_that_it_links_to_exist() -> None:
    links = [t for t in re.findall(r"\]\(([^)#]+)\)", TEXT) if not t.startswith("http")]
    assert links
    for link in links:
        assert (ROOT / link).exists(), link


def test_folders_are_those_that_are_there() -> None:
    (block,) = [b for b in re.findall(r"```\w*\n(.*?)```", TEXT, re.DOTALL) if "notebooks/ " in b]
    for line in block.splitlines():
        assert (ROOT / line.split()[0]).exists(), line


def test_minutes_are_those_of_the_notebooks_as_computed_and_not_too_many() -> None:
    said = dict(re.findall(r"^\| `(\w+)` \| (\d+) min \|", TEXT, re.MULTILINE))
    paths = find([])
    assert [path.stem for path in paths] == list(said)
    for path in paths:
        minutes = re.search(r"Core: about (\d+) minutes", path.read_text(encoding="utf-8"))
        assert minutes, path
        assert minutes.group(1) == said[path.stem]

    computed = {path.stem: core_minutes(read(path)) for path in paths}
    assert said == {name: f"{minutes:.0f}" for name, minutes in computed.items()}
    assert max(computed.values()) <= MOST
    assert sum(computed.values()) <= MOST_OF_ALL


def test_the_numbers_of_claims_are_those_of_the_table() -> None:
    with (REFERENCE.parent / "claims.csv").open(encoding="utf-8", newline="") as file:
        verdicts = [row["verdict"] for row in csv.DictReader(file)]
    wrong, imprecise = verdicts.count("wrong"), verdicts.count("imprecise")
    assert f"of its {len(verdicts)} claims {wrong} are wrong and {imprecise} imprecise" in TEXT
