"""What the READMEs name exists: links, commands and their options, parameters, benchmarks; their Python compiles."""

import json
import re
import shlex
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import pytest

import jaxba
from jaxba.cli import main
from jaxba.cli._main import app
from jaxba.design import sections as plan_sections
from jaxba.engine import explained

ROOT = Path(jaxba.__file__).parents[1]
READMES = sorted({ROOT / "README.md", ROOT / "benchmarks" / "README.md", *(ROOT / "jaxba").rglob("README.md")})
READMES = [path for path in READMES if path.is_file()]  # a wheel has those of the packages alone
EVERY = pytest.mark.parametrize("readme", READMES, ids=lambda path: str(path.relative_to(ROOT)))
needs_root = pytest.mark.skipif(ROOT / "README.md" not in READMES, reason="needs README.md, which is not in this copy")

_LINK = re.compile(r"\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
_BENCHMARK = re.compile(r"python -m (benchmarks\.\w+)")
_SUFFIXES = ("py", "csv", "md", "toml")  # `export.py` is no parameter


def anchors(path: Path) -> set[str]:
    """Return the anchors that GitHub gives to a file's headings."""
    bare = _FENCE.sub("", path.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.*)$", bare, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command line of jaxba or of a benchmark, in blocks and between backticks."""
    blocks = [block for language, block in _FENCE.findall(text) if language != "python"]
    spans = re.findall(r"`([^`]+)`", _FENCE.sub("", text))
    joined = [*"\n".join(blocks).replace("\\\n", " ").splitlines(), *(span.replace("\n", " ") for span in spans)]
    for line in joined:
        for part in re.split(r"&&", line):
            words = shlex.split(part, comments=True) if part.count('"') % 2 == 0 and "'" not in part else []
            if len(words) > 3 and words[0].endswith("python") and words[1] == "-m":
                words = words[2:]
            if words and (words[0] == "jaxba" or words[0].startswith("benchmarks.")):
                yield words


def options_of(command: str) -> set[str]:
    """Return the options of a command of jaxba."""
    found = app[command].assemble_argument_collection(parse_docstring=False)
    return {name for argument in found for name in argument.names if name.startswith("--")}


def options_of_benchmark(module: str) -> set[str]:
    source = ROOT.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8")
    return set(re.findall(r'add_argument\(\s*"(--[\w-]+)"', source))


@EVERY
def test_every_relative_link_resolves(readme: Path):
    for link in _LINK.findall(readme.read_text(encoding="utf-8")):
        if "://" in link:
            continue
        place, _, anchor = link.partition("#")
        target = (readme.parent / place).resolve() if place else readme
        if ROOT / "README.md" in READMES:
            assert target.exists(), link
        if anchor and target.exists():
            assert anchor in anchors(target), link


@EVERY
def test_python_of_the_readme_compiles(readme: Path):
    for language, block in _FENCE.findall(readme.read_text(encoding="utf-8")):
        if language == "python":
            compile(block, str(readme), "exec")


@needs_root
def test_readme_is_short_and_has_the_two_commands():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    first, second = [line for line in lines if line.startswith("python3 -m venv ")]
    assert "-m jaxba run" in first and second.endswith("-m pytest")
    assert len(lines) <= 130


@needs_root
@EVERY
def test_benchmarks_exist(readme: Path):
    for module in _BENCHMARK.findall(readme.read_text(encoding="utf-8")):
        assert ROOT.joinpath(*module.split(".")).with_suffix(".py").is_file(), module


@needs_root
@EVERY
def test_commands_and_their_options_exist(readme: Path):
    for words in commands(readme.read_text(encoding="utf-8")):
        given = set(_OPTION.findall(" ".join(word for word in words if word.startswith("--"))))
        if words[0] == "jaxba":
            allowed = {"--help", "--version"} if words[1:2] == ["--help"] else options_of(words[1])
        else:
            allowed = options_of_benchmark(words[0])
        assert given <= allowed, words


@needs_root
@EVERY
def test_options_named_in_the_text_exist(readme: Path):
    known = {option for command in app if not command.startswith("-") for option in options_of(command)}
    known |= {"--help", "--version"}
    bare = _FENCE.sub("", readme.read_text(encoding="utf-8"))
    spans = [span for span in re.findall(r"`([^`]+)`", bare) if "benchmarks." not in span]
    assert {option for span in spans for option in _OPTION.findall(span)} <= known


@EVERY
def test_parameters_exist(readme: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["config", "--json"])
    known = {row["name"] for row in json.loads(capsys.readouterr().out)["parameters"]}
    known |= {name for name, *_ in explained(plan_sections())}
    sections = "|".join({name.partition(".")[0] for name in known})
    text, _, _ = readme.read_text(encoding="utf-8").partition("| field | meaning |")  # of report.json, not parameters
    named = re.findall(rf"(?<![\w./])((?:{sections})\.([a-z_]+))\b(?!\()", text)
    wrong = {name for name, last in named if last not in _SUFFIXES} - known
    assert not wrong


@needs_root
def test_every_check_above_found_something():
    text = "".join(path.read_text(encoding="utf-8") for path in READMES)
    used = {words[0] if words[0] != "jaxba" else words[1] for words in commands(text)}
    assert {"run", "simulate", "status", "verify", "diagnose", "config", "solve", "gradcheck"} <= used
    assert {"benchmarks.run", "benchmarks.memory", "benchmarks.gradients", "benchmarks.truth"} <= used
    assert len(set(_BENCHMARK.findall(text))) >= 10 and {"--gcp", "--crs", "--set"} <= options_of("run")
    links = [link for link in _LINK.findall(text) if "://" not in link]
    assert len(links) > 50 and sum("#" in link for link in links) > 20
    assert sum(language == "python" for language, _ in _FENCE.findall(text)) >= 3
    bare = _FENCE.sub("", text)
    assert {"--gcp", "--set"} <= {option for span in re.findall(r"`([^`]+)`", bare) for option in _OPTION.findall(span)}


def test_the_example_of_a_stage_runs(monkeypatch: pytest.MonkeyPatch):
    from jaxba.report import Told

    text = (ROOT / "jaxba" / "pipeline" / "README.md").read_text(encoding="utf-8")
    (source,) = [block for language, block in _FENCE.findall(text) if language == "python"]
    stage = types.ModuleType("example_stage")
    monkeypatch.setitem(sys.modules, stage.__name__, stage)
    exec(compile(source, "example_stage", "exec"), vars(stage))
    outputs, told = stage.run(stage.Inputs(heights_m=(60.0, 3.0)), stage.Params()), Told(photos=("a.jpg", "b.jpg"))
    assert stage.lines(outputs, told) == ["1 of 2 photos are high enough"]
    assert stage.facts(outputs, told) == {"kept": ["a.jpg"]}
