from .content import ReportContent, SnapshotSummary, relative_prior_std
from .page import render, write_report

__all__ = [
    "ReportContent",
    "SnapshotSummary",
    "relative_prior_std",
    "render",
    "write_report",
]
