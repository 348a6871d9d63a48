"""The import rules of pyproject.toml hold."""

from importlinter.cli import lint_imports


def test_import_rules_are_kept() -> None:
    assert lint_imports(no_cache=True) == 0
