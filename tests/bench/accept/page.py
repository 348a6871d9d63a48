"""A report as a reader has it."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

BLOCKS = {"td", "th", "div", "p", "li", "summary", "figure", "h2", "h3", "dt", "dd"}
VOID = {"meta", "col", "img", "wbr", "rect", "br"}


class Page(HTMLParser):
    """A page as a reader has it: text, links, pictures, rows of tables; raises where tags do not match."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.text, self.rows, self.tags = "", [], []
        self.links: list[str] = []
        self.sources: list[str] = []
        self.ids: set[str] = set()
        self.headings: list[str] = []
        self.subject: dict[str, str] = {}
        """What stands beside each word of the subject, and of other lists of pairs."""
        self._open: list[str] = []
        self.feed(path.read_text("utf-8"))
        self.close()
        self.text = " ".join(self.text.split())
        self.rows, self.headings = ([" ".join(text.split()) for text in each] for each in (self.rows, self.headings))
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        values = dict(attrs)
        self.ids |= {values["id"] or ""} if "id" in values else set()
        self.links += [values["href"] or ""] if "href" in values else []
        self.sources += [values["src"] or ""] if "src" in values else []
        if tag not in VOID:
            self._open.append(tag)
        if tag == "tr":
            self.rows.append("")
        if tag == "h2":
            self.headings.append("")
        if tag in BLOCKS:
            self.handle_data(" ")

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self._open:
            return
        self.text += data
        if "tr" in self._open:
            self.rows[-1] += data
        if "h2" in self._open:
            self.headings[-1] += data
        if "dt" in self._open:
            self._word = data
        if "dd" in self._open:
            self.subject[self._word] = " ".join(f"{self.subject.get(self._word, '')} {data}".split())

    def row(self, *needles: str) -> str:
        """The row with all of them; of several, they are the same."""
        (found,) = {row for row in self.rows if all(needle in row for needle in needles)}
        return found
