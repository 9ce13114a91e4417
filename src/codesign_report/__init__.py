"""Trial bags to videos, charts and summaries. Needs no ROS installation."""

from codesign_report.bag import BagError, read_trial, trial_metrics
from codesign_report.recording import (
    Domain,
    MotionSeries,
    SoftBody,
    StressSeries,
    TriangleMesh,
    TrialRecording,
)

__all__ = [
    "BagError",
    "Domain",
    "MotionSeries",
    "SoftBody",
    "StressSeries",
    "TrialRecording",
    "TriangleMesh",
    "read_trial",
    "trial_metrics",
]
