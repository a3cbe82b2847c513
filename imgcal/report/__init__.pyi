from .content import ReportContent, SnapshotSummary
from .page import render, write_report

__all__ = [
    "ReportContent",
    "SnapshotSummary",
    "render",
    "write_report",
]
