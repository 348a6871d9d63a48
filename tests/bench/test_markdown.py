"""Tables show every text as it is, whatever it holds: CommonMark's reference parser in Python reads them back."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from bench.view import markdown
from protocol.text import printable

READER = MarkdownIt("commonmark").enable("table").enable("strikethrough")
HOSTILE = st.text(st.sampled_from("ab_ *`|[]()<>!\\~&#-=;:/\n\t\"'0"), max_size=30) | st.text(
    st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20
)


def cells(text: str) -> list[str]:
    """The cells of the only table in `text`; an AssertionError where one holds more than plain text."""
    tokens = READER.parse(text)
    assert [token.type for token in tokens if token.level == 0] == ["table_open", "table_close"]
    found = [token for token in tokens if token.type == "inline"]
    assert {child.type for token in found for child in token.children or []} <= {"text", "text_special"}
    return ["".join(child.content for child in token.children or []) for token in found]


@settings(deadline=None)
@given(st.lists(st.tuples(HOSTILE, HOSTILE), max_size=3))
def test_every_cell_shows_its_text(rows: list[tuple[str, str]]) -> None:
    shown = cells(markdown.table(("name", ""), rows))
    assert shown == ["name", "", *(printable(text).strip() for row in rows for text in row)]


@pytest.mark.parametrize("text", ["run_1.run", "theta_vt", "tcp:127.0.0.1:5000", "12.5 kHz"])
def test_ordinary_text_stays_as_it_is(text: str) -> None:
    assert markdown.escaped(text) == text
