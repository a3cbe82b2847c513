"""The report: one self-contained HTML page that shows a recalibration."""

from imgcal.report.content import ReportContent, SnapshotSummary, relative_prior_std
from imgcal.report.page import render, write_report

__all__ = ["ReportContent", "SnapshotSummary", "relative_prior_std", "render", "write_report"]
