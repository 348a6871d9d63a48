"""`python -m tests.doctor`: which tools of the tests work on this machine, and what brings those that do not.

Ends with 1 if one is missing; the tests that need it are then skipped.
"""

from __future__ import annotations

import sys

from tests.tools import TOOLS, missing


def main() -> int:
    """Print a line for each tool."""
    width = max(map(len, TOOLS))
    absent = 0
    for name, tool in TOOLS.items():
        why = missing(name)
        absent += bool(why)
        print(f"{name:{width}}  " + (f"missing: {why}; {tool.brought_by}" if why else "works"))
    print(f"{len(TOOLS) - absent} of {len(TOOLS)} work; tests that need another are skipped")
    return int(absent > 0)


if __name__ == "__main__":
    sys.exit(main())
