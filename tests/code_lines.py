"""`python -m tests.code_lines`: code lines by package; none that is blank, a comment, a docstring or an import."""

from __future__ import annotations

import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("bench", "sim", "protocol", "tests")
SPACE = {tokenize.COMMENT, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER, tokenize.ENCODING}


def code_lines(file: Path) -> int:
    """How many lines of a file are code."""
    lines: set[int] = set()
    statement: list[tokenize.TokenInfo] = []
    with file.open("rb") as text:
        for token in tokenize.tokenize(text.readline):
            if token.type == tokenize.NEWLINE:
                imports = statement[0].string in ("import", "from")
                if not imports and any(part.type != tokenize.STRING for part in statement):
                    lines.update(n for part in statement for n in range(part.start[0], part.end[0] + 1))
                statement = []
            elif token.type not in SPACE:
                statement.append(token)
    return len(lines)


def counted(package: str) -> int:
    """The code lines of a package."""
    return sum(code_lines(file) for file in (ROOT / package).rglob("*.py"))


if __name__ == "__main__":
    for name in PACKAGES:
        print(name, counted(name))
