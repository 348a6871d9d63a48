"""Help texts, descriptions of limits, channels and parameters, and plots' names use the words of docs/glossary.md."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import click
import pytest

from bench.accept.results import run_from_json
from bench.cli import cli
from bench.plot.plot import NAMES
from protocol.codes import ErrorCode, Fault
from protocol.signals import DRIVE_CHANNELS, DRIVE_PARAMETERS, LOAD_CHANNELS, LOAD_PARAMETERS

ROOT = Path(__file__).parents[2]
GLOSSARY = ROOT / "docs" / "glossary.md"
DEFAULT_CONFIG = ROOT / "sim" / "default.toml"
ROW = re.compile(r"^\|([^|]*)\|([^|]*)\|([^|]*)\|$", re.MULTILINE)
WORD = re.compile(r'\s*([^,(]+?)\s*(?:\(except ("[^)]*")\)\s*)?(?:,|$)')


class Forbidden(NamedTuple):
    """A word that is not used for `term`, and the phrases in which it is right."""

    word: str
    term: str
    allowed: tuple[str, ...]


def rows() -> list[tuple[str, str]]:
    """Terms, and the words that are not used for them."""
    found = [(row[1].strip(), row[3].strip()) for row in ROW.finditer(GLOSSARY.read_text(encoding="utf-8"))]
    return [row for row in found if row[0] != "term" and not set(row[0]) <= {"-"}]


def forbidden() -> list[Forbidden]:
    return [
        Forbidden(match[1], term, tuple(re.findall('"([^"]+)"', match[2] or "")))
        for term, words in rows()
        for match in WORD.finditer(words)
    ]


def as_words(word: str) -> re.Pattern[str]:
    """That word or those words, in singular or plural, whatever the case and the white space between."""
    inner = r"\s+".join(map(re.escape, word.split()))
    return re.compile(rf"(?<![\w/]){inner}(?:s|es)?(?![\w/])", re.IGNORECASE)


def faults_of(text: str) -> list[str]:
    """What a text has that the glossary does not allow."""
    found = []
    for one in forbidden():
        rest = text
        for phrase in one.allowed:
            rest = re.sub(rf"(?<!\w){re.escape(phrase)}(?!\w)", " ", rest)
        if match := as_words(one.word).search(rest):
            found.append(f"'{match[0]}' is not used: write '{one.term}'")
    return found


def tree(command: click.Command, path: str) -> Iterator[tuple[str, click.Command]]:
    yield path, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            below = command.get_command(context, name)
            assert below is not None
            yield from tree(below, f"{path} {name}")


def help_texts() -> Iterator[tuple[str, str]]:
    """Every text of `--help`, by where it stands: also those that only the group's own help has."""
    for path, command in tree(cli, "bench"):
        # click keeps the first names that it sees
        context = click.Context(command, info_name=path, help_option_names=["-h", "--help"])
        yield f"{path} --help", command.get_help(context)
        for what, text in (("help", command.help), ("short help", command.short_help), ("epilog", command.epilog)):
            if text:
                yield f"{path}: {what}", text
        for parameter in command.params:
            if isinstance(parameter, click.Option) and parameter.help:
                yield f"{path} {parameter.opts[-1]}", parameter.help


def described() -> Iterator[tuple[str, str]]:
    """Channels, parameters, comments of the simulated drive's configuration, codes, plots."""
    for each in (*DRIVE_CHANNELS, *LOAD_CHANNELS, *DRIVE_PARAMETERS, *LOAD_PARAMETERS):
        yield each.name, each.about
    for number, line in enumerate(DEFAULT_CONFIG.read_text(encoding="utf-8").splitlines(), 1):
        if comment := line.partition("#")[2].strip():
            yield f"{DEFAULT_CONFIG.name}, line {number}", comment
    for code in (*Fault, *ErrorCode):
        yield type(code).__name__, code.name.replace("_", " ")
    for name in NAMES:
        yield "bench plot", name.replace("_", " ")


def broken(texts: Iterator[tuple[str, str]]) -> list[str]:
    return [f"{where}: {fault}" for where, text in texts for fault in faults_of(text)]


def test_the_tables_are_read() -> None:
    terms = [term for term, _ in rows()]
    assert len(terms) > 60
    assert len(terms) == len(set(terms))
    assert Forbidden("figure", "plot", ("RUN.figures",)) in forbidden()
    assert {"T/6", "both ways", "test bench"} <= {one.word for one in forbidden()}
    assert not {one.word for one in forbidden()} & set(terms)


@pytest.mark.parametrize(("text", "faults"), [
    ("Write the plots", 0),
    ("Write all Figures", 2),  # it is neither a plot nor a statistic
    ("Folder for the plots [default: RUN.figures]", 0),
    ("[default: RUN.figures] of the figures", 2),
    ("turn it both\n  ways", 1),
    ("an estimator's lag", 1),
    ("bounded memory, reconfigured", 0),
])  # fmt: skip
def test_forbidden_words_are_found_as_whole_words(text: str, faults: int) -> None:
    assert len(faults_of(text)) == faults


def test_help_texts_use_the_words_of_the_glossary() -> None:
    texts = list(help_texts())
    assert len(texts) > 150
    assert broken(iter(texts)) == []


def test_descriptions_use_the_words_of_the_glossary() -> None:
    texts = list(described())
    assert len(texts) > 150
    assert broken(iter(texts)) == []


@pytest.mark.long("the whole suite")
def test_limits_use_the_words_of_the_glossary(suite_run: Path) -> None:
    limits = [m.limits for m in run_from_json(json.loads((suite_run / "a.json").read_text())).measurements]
    assert len(limits) > 300
    assert sorted(broken(iter({(limit.name, limit.about) for limit in limits}))) == []


def test_every_term_is_used() -> None:
    pages = [ROOT / "README.md", *(page for page in (ROOT / "docs").glob("*.md") if page != GLOSSARY)]
    used = "\n".join([*(page.read_text(encoding="utf-8") for page in pages), *(text for _, text in help_texts())])
    terms = [part for term, _ in rows() for part in re.split(r", ", term)]
    assert [term for term in terms if not as_words(term).search(used)] == []
