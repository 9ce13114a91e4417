"""Trial bags to videos, charts and summaries. Needs no ROS installation."""

from codesign_report.bag import BagError, read_trial, trial_metrics
from codesign_report.build import RunReport, build
from codesign_report.recording import (
    MotionSeries,
    SoftBody,
    StressSeries,
    TrialDomain,
    TrialRecording,
    TriangleMesh,
)
from codesign_report.report import SkippedBag, TrialResult, write_report, write_summary

__all__ = [
    "BagError",
    "MotionSeries",
    "RunReport",
    "SkippedBag",
    "SoftBody",
    "StressSeries",
    "TrialDomain",
    "TrialRecording",
    "TrialResult",
    "TriangleMesh",
    "build",
    "read_trial",
    "trial_metrics",
    "write_report",
    "write_summary",
]
