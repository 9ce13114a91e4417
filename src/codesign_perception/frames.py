"""Pictures as they come from a camera: which of them are to be believed, and why not the others."""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np

from codesign_perception.edges import Image

JUMP = 1_000_000_000  # ns back in time that mean a new clock, not an old picture


class FrameGate:
    """Lets through fresh pictures only.

    Args:
        max_age: between a picture's stamp and its arrival [s].
        frozen_after: pictures with equal bytes, one after the other, that mean that the camera
            hangs; 0: never.
    """

    def __init__(self, max_age: float = 0.2, frozen_after: int = 3) -> None:
        self.counts: Counter[str] = Counter()
        self._max_age = round(max_age * 1e9)
        self._frozen_after = frozen_after
        self._stamp: int | None = None
        self._digest = 0
        self._equal = 1

    @property
    def frozen(self) -> bool:
        """Whether the last pictures were all the same."""
        return 0 < self._frozen_after <= self._equal

    def objection(self, stamp: int, now: int, data: bytes | memoryview) -> str:
        """Why a picture is not to be used; empty: use it.

        Args:
            stamp, now: of the picture and of its arrival, by the same clock [ns].
            data: the encoded picture.
        """
        if not len(data):
            return self._refuse("empty", "empty picture: the camera's driver sends no data")
        if abs(now - stamp) > self._max_age:
            return self._refuse(
                "stale",
                f"picture is {(now - stamp) * 1e-9:.2f} s old, at most {self._max_age * 1e-9:.2f}: "
                "slow network, or clocks that differ",
            )
        if self._stamp is not None and 0 < self._stamp - stamp < JUMP:
            return self._refuse("stale", "picture is older than the one before")
        digest = hash(bytes(data))
        if stamp != self._stamp:  # else sent again, as in lockstep
            self._equal = self._equal + 1 if digest == self._digest else 1
        self._stamp, self._digest = stamp, digest
        if self.frozen:
            return self._refuse(
                "frozen", f"{self._equal} equal pictures: the camera hangs, restart its driver"
            )
        return ""

    def decoded(self, data: bytes | memoryview) -> Image | None:
        """The picture, (height, width, 3) BGR; None, and counted, if it cannot be read."""
        image = decode(data)
        if image is None:
            self.counts["corrupt"] += 1
        return image

    def _refuse(self, kind: str, reason: str) -> str:
        self.counts[kind] += 1
        return reason


def decode(data: bytes | memoryview) -> Image | None:
    """A JPEG or PNG picture, (height, width, 3) BGR; None if it is cut off or no picture."""
    buffer = np.frombuffer(data, dtype=np.uint8)
    if len(buffer) < 32:
        return None
    if buffer[0] == 0xFF and buffer[1] == 0xD8:
        # A JPEG that was cut off still decodes, grey where data is missing: look for its end.
        end = bytes(buffer[-64:])
        if b"\xff\xd9" not in end:
            return None
    image = cv2.imdecode(buffer, cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image, dtype=np.uint8)


def encode(image: Image, quality: int = 90) -> bytes:
    """A BGR picture as JPEG."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise RuntimeError("OpenCV cannot write JPEG")
    return data.tobytes()
