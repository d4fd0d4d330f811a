"""The self-contained HTML report of a mission."""

from host_tools.report.page import write_report

__all__ = ["write_report"]
