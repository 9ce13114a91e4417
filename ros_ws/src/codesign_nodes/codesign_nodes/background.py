"""Long work in a process of its own: the node goes on, and what takes too long is ended."""

import contextlib
import multiprocessing
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any


class JobError(RuntimeError):
    """The work failed, died or took too long; the message says which."""


class Job:
    """A function call in a child process, watched by a thread that only waits.

    Children are forked off a server that has imported `preload` once, so that from the second job
    on they start at once. Function, arguments and result are pickled.
    """

    def __init__(
        self, work: Callable[..., Any], *arguments: Any, limit: float, preload: tuple[str, ...] = ()
    ) -> None:
        """Starts at once; limit: longest time of the work, without the server's imports [s]."""
        self._call = (work, arguments)
        self._limit = limit
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(list(preload))
        self._process: Any = None
        self._answer: tuple[str, Any] = ("stopped", None)
        self._started = time.monotonic()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self._started

    def done(self) -> bool:
        """Whether there is a result, or never will be."""
        return not self._thread.is_alive()

    def result(self) -> Any:
        """What the work returned, once `done`.

        Raises:
            JobError: it raised an error, died, took too long or was stopped.
        """
        error, value = self._answer
        if error:
            raise JobError(error)
        return value

    def stop(self) -> None:
        """Ends the process, if it still runs."""
        self._stopped = True
        if self._process is not None:
            self._process.kill()

    def _run(self) -> None:
        receiver, sender = self._context.Pipe(duplex=False)
        process = self._context.Process(target=_child, args=(sender, *self._call), daemon=True)
        process.start()
        self._process = process
        sender.close()  # the child's end is the only one: it is closed when the child ends
        with receiver:
            if self._stopped or not receiver.poll(self._limit):
                process.kill()
                self._answer = (f"not done within {self._limit:g} s", None)
                return
            try:
                self._answer = receiver.recv()
            except EOFError:
                process.join(1.0)
                self._answer = (f"the process ended with code {process.exitcode}", None)


def _child(sender: Connection, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):
        try:
            answer = ("", work(*arguments))
        except (ValueError, OSError) as error:
            answer = (str(error), None)
        except Exception as error:
            answer = (f"{type(error).__name__}: {error}", None)
        sender.send(answer)
