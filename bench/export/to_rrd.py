"""A file for rerun's viewer: the dashboard that the run had live. It is a picture, see `bench.view.viewing`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bench.export.content import Content
from bench.view.viewing import closeups, write_rrd


def files(content: Content, out: Path) -> dict[str, Path]:
    """The one file."""
    return {"dashboard": out}


def write(content: Content, paths: Mapping[str, Path]) -> None:
    """Write it to `paths`. Raises RecordingError."""
    write_rrd(content.run, paths["dashboard"], *content.said)
    content.run.look_at_times(*content.said)


def notes(content: Content) -> list[str]:
    """What is not shown sample by sample."""
    if closeups(content.run, *content.said) is None:
        return []
    return ["more than a minute, and 60,000 samples, is shown as minima and maxima: use --from and --to for less"]
