"""Whether the device side in C can be compiled here, for tests that go through it."""

from __future__ import annotations

import pytest

from protocol.device.compiled import NoCompiler, compiler


def _missing() -> str:
    try:
        compiler()
    except NoCompiler as why:
        return str(why)
    return ""


needs_compiler = pytest.mark.skipif(bool(_missing()), reason=_missing())
