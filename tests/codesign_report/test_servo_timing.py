"""Lateness of the servo stream, from what the bench wrote."""

import numpy as np
import pytest

from codesign_report.timing import servo_timing

RESULT = {
    "rate_hz": 250,
    "sched_fifo": True,
    "state": "streaming",
    "ticks_missed": 2,
    "replies_late": 1,
    "pauses": 0,
}


def test_percentiles_are_milliseconds_of_the_lateness() -> None:
    timing = servo_timing(RESULT | {"lateness_s": (np.arange(101) * 1e-5).tolist()})
    assert (timing.p50, timing.p99, timing.max) == pytest.approx((0.5, 0.99, 1.0))
    assert (timing.ticks, timing.ticks_missed, timing.replies_late) == (101, 2, 1)
    assert timing.sched_fifo
    assert timing.streamed


def test_a_stream_that_ended_early_is_told() -> None:
    assert not servo_timing(RESULT | {"lateness_s": [1e-4], "state": "fault"}).streamed


def test_no_wake_ups_are_no_result() -> None:
    with pytest.raises(ValueError, match="no wake-ups"):
        servo_timing(RESULT | {"lateness_s": []})
