"""Ctrl-C as a request: a run finishes its round, saves and ends."""

import signal
from types import FrameType, TracebackType


class Interruption:
    """While in use, the first SIGINT or SIGTERM is only remembered; a second one interrupts.

    with Interruption() as interrupted:
        training.run(folder, stop=interrupted)
    """

    def __init__(self) -> None:
        self._requested = False
        self._previous: dict[int, object] = {}

    def __call__(self) -> bool:
        """Whether an end was asked for."""
        return self._requested

    def __enter__(self) -> "Interruption":
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._remember)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if self._requested:
            raise KeyboardInterrupt
        self._requested = True
