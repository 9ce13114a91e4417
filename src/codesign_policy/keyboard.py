"""Single keys from a terminal, without waiting for Enter."""

import atexit
import contextlib
import os
import select
import termios
import tty


class Keyboard:
    """Puts a terminal into cbreak mode until it is closed, at the latest when Python ends.

    Ctrl-C still interrupts, and what is typed is not shown.
    """

    def __init__(self, descriptor: int) -> None:
        """Args: file descriptor of a terminal, such as `sys.stdin.fileno()`.

        Raises:
            ValueError: it is none.
        """
        if not os.isatty(descriptor):
            raise ValueError(f"file descriptor {descriptor} is not a terminal: start it in one")
        self._descriptor = descriptor
        self._before = termios.tcgetattr(descriptor)
        atexit.register(self.close)
        tty.setcbreak(descriptor, termios.TCSANOW)

    def read(self) -> str:
        """The keys since the last call; does not wait."""
        keys = b""
        while select.select([self._descriptor], [], [], 0.0)[0]:
            more = os.read(self._descriptor, 64)
            if not more:  # the terminal is gone
                break
            keys += more
        return keys.decode(errors="ignore")

    def close(self) -> None:
        """Gives the terminal its mode back; may be called again."""
        atexit.unregister(self.close)
        with contextlib.suppress(termios.error):  # a terminal that is gone needs none
            termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)
