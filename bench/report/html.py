"""The shell of every HTML report: one self-contained file, in which whatever anybody says is text, never markup."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from bench.report.words import labelled, plain
from protocol.text import counted

MOST_LETTERS = 90  # of a string in a page's margin


def page(package: str, template: str, filters: Iterable[Callable[..., Any]], **given: Any) -> str:
    """The page that `template` of a package makes of what is given; it may include `style.css.j2`.

    Its filters go by the functions' names, without an underscore at the front.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package, ""), PackageLoader("bench.report", "")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    filters = (counted, css_string, labelled, plain, *filters)
    environment.filters |= {function.__name__.lstrip("_"): function for function in filters}
    return environment.get_template(template).render(given)


def css_string(text: str) -> Markup:
    """A string for a style sheet in a page: all but plain letters and digits is escaped, so it ends nothing."""
    shown = " ".join(text.split())[:MOST_LETTERS]
    return Markup(
        '"' + "".join(c if c == " " or (c.isascii() and c.isalnum()) else f"\\{ord(c):x} " for c in shown) + '"'
    )


def embedded(picture: Path) -> str:
    """A PNG as a data URI: nothing is fetched when the page is read. Raises OSError."""
    return "data:image/png;base64," + base64.b64encode(picture.read_bytes()).decode("ascii")
