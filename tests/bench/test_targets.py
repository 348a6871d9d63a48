"""A kind of target is added in one place: where its class is defined. Commands, errors and completion then know it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from bench.cli import cli
from bench.cli.target import TARGET
from protocol.errors import TargetError
from protocol.links import open_link, parse_target
from protocol.links.target import Target


class Opened:
    """What opens it."""

    def __init__(self, target: Target) -> None:
        self.target = target


@pytest.fixture
def pipe(monkeypatch: pytest.MonkeyPatch) -> type[Target]:
    monkeypatch.setattr(Target, "kinds", dict(Target.kinds))

    @dataclass(frozen=True)
    class Pipe(Target):
        scheme = "pipe"
        form = "pipe:PATH"
        example = "pipe:/tmp/a"
        link = f"{__name__}.Opened"
        path: str

        @classmethod
        def read(cls, text: str, address: str, options: Mapping[str, str]) -> Pipe:
            return cls(address)

        @staticmethod
        def here() -> list[str]:
            return ["pipe:/tmp/a"]

    return Pipe


def test_a_kind_of_target_is_known_everywhere_by_being_defined(
    pipe: type[Target], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = open_link("pipe:/tmp/a")
    assert isinstance(link, Opened)
    assert link.target == pipe("/tmp/a")  # type: ignore[call-arg]
    with pytest.raises(TargetError, match=r" or pipe:/tmp/a$"):
        parse_target("nothing:x")
    with pytest.raises(TargetError, match=r"did you mean pipe:\?"):
        parse_target("pipes:x")
    completed = TARGET.shell_complete(click.Context(cli), click.Argument(["target"]), "pi")
    assert [item.value for item in completed] == ["pipe:/tmp/a"]
    monkeypatch.chdir(tmp_path)
    Path("a").touch()
    assert "can:INTERFACE/CHANNEL, pipe:PATH" in CliRunner().invoke(cli, ["info", "a"]).output
    told = CliRunner().invoke(cli, ["info", "--json", "pipe:/tmp/a"]).output
    assert "would write to a file named pipe:/tmp/a: put --json last" in told
