"""Work in another process: its result, its error, its death and its lateness."""

import os
import time
from typing import Any

import pytest


def outcome(work: Any, *arguments: Any, limit: float = 60.0) -> Any:
    from codesign_nodes.background import Job

    job = Job(work, *arguments, limit=limit)
    deadline = time.monotonic() + 120.0
    while not job.done():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return job.result()


def test_the_result_comes_back() -> None:
    assert outcome(pow, 2, 100_000) == 2**100_000  # larger than a pipe's buffer
    assert outcome(os.getpid) != os.getpid()


@pytest.mark.parametrize(
    ("work", "arguments", "limit", "said"),
    [
        (int, ("seven",), 60.0, "invalid literal for int"),
        (os.listdir, ("/no/such/folder",), 60.0, "No such file"),
        (len, (3,), 60.0, "TypeError: object of type 'int' has no len"),
        (os._exit, (3,), 60.0, "the process ended with code 3"),
        (time.sleep, (60.0,), 0.2, "not done within 0.2 s"),
    ],
)
def test_failures_say_what_happened(work: Any, arguments: Any, limit: float, said: str) -> None:
    from codesign_nodes.background import JobError

    with pytest.raises(JobError, match=said):
        outcome(work, *arguments, limit=limit)


def test_a_stopped_job_ends() -> None:
    from codesign_nodes.background import Job, JobError

    job = Job(time.sleep, 600.0, limit=600.0)
    job.stop()
    while not job.done():
        time.sleep(0.01)
    with pytest.raises(JobError):
        job.result()
