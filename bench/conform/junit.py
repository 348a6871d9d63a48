"""The results as JUnit XML: a suite for each level, a case for each check."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from bench.conform.claim import by_level, claim
from bench.conform.run import Run
from bench.conform.verdicts import WORDS
from bench.signal.verdict import Verdict
from protocol.text import printable, told


def as_xml(run: Run, about_run: dict[str, Any]) -> str:
    """The document. What is unknown or not applicable is skipped, with the reason."""
    root = ElementTree.Element("testsuites", name="bench conform")
    for name, results in by_level(run.results):
        counts = {verdict: sum(r.verdict is verdict for r in results) for verdict in WORDS}
        suite = ElementTree.SubElement(
            root, "testsuite", name=name, tests=str(len(results)), failures=str(counts[Verdict.FAIL]), errors="0",
            skipped=str(counts[Verdict.INVALID] + counts[Verdict.SKIPPED]),
            time=f"{sum(r.seconds for r in results):.3f}",
        )  # fmt: skip
        properties = ElementTree.SubElement(suite, "properties")
        for key, value in (about_run | {"claim": claim(run).words}).items():
            ElementTree.SubElement(properties, "property", name=key, value=printable(str(told(value))))
        for result in results:
            family, _, _ = result.check.id.partition(".")
            case = ElementTree.SubElement(
                suite, "testcase", classname=f"hbp.{family}", name=result.check.id, time=f"{result.seconds:.3f}"
            )
            words = printable(result.evidence)
            if result.verdict is Verdict.FAIL:
                says = f"SPEC {result.check.cites[0]}: {result.check.says}"
                ElementTree.SubElement(case, "failure", message=words, type="failed").text = says
            elif result.verdict is not Verdict.PASS:
                ElementTree.SubElement(case, "skipped", message=f"{WORDS[result.verdict]}: {words}")
            ElementTree.SubElement(case, "system-out").text = words
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
