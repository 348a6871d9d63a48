"""The report of an acceptance run: one HTML file to read, hand over and print."""

from bench.accept.report.html import ReportError, write_report

__all__ = ["ReportError", "write_report"]
