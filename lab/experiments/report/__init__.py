"""What was found, for people: figures, one page of HTML and one of Markdown, and two runs side by side."""

from lab.experiments.report.writing import Report, write_report

__all__ = ["Report", "write_report"]
