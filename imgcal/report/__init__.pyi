from .content import NOT_IDENTIFIED, UNKNOWN_MARKERS, ReportContent, SnapshotSummary
from .fleet_page import Taught, write_fleet_report
from .page import render, write_report
from .rig_view import DrawnRig, rig_scene, rig_view_script

__all__ = [
    "NOT_IDENTIFIED",
    "UNKNOWN_MARKERS",
    "DrawnRig",
    "ReportContent",
    "SnapshotSummary",
    "Taught",
    "render",
    "rig_scene",
    "rig_view_script",
    "write_fleet_report",
    "write_report",
]
