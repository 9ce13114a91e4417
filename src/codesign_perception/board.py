"""The ChArUco board: drawing it, and finding its corners in a picture.

Its frame lies in the middle of the printed pattern: x to the right, y towards the first row, z out
of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from codesign_perception.camera import Floats
from codesign_perception.edges import Image

DICTIONARY = cv2.aruco.DICT_5X5_250
FEWEST = 8  # corners of a view that is worth something


@dataclass(frozen=True)
class View:
    """What one picture shows of the board.

    Attributes:
        points: (N, 3) corners in the board's frame [m].
        pixels: (N, 2) where they appear.
    """

    points: Floats
    pixels: Floats


@dataclass(frozen=True)
class CharucoBoard:
    """Chess board of `columns` x `rows` squares with markers in the white ones; A4 holds this one.

    Attributes:
        square, marker: edge lengths [m]. Measure the print: a printer's "fit to page" changes them.
    """

    columns: int = 9
    rows: int = 6
    square: float = 0.030
    marker: float = 0.022

    def __post_init__(self) -> None:
        """Raises ValueError for a board that cannot be."""
        if not (3 <= self.columns <= 20 and 3 <= self.rows <= 20):
            raise ValueError(f"board of {self.columns} x {self.rows} squares: 3 to 20 each")
        if not 0.001 <= self.marker < self.square <= 1.0:
            raise ValueError(
                f"marker {self.marker} m in a square of {self.square} m: must be smaller, both "
                "0.001 to 1 m"
            )

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the pattern [m]."""
        return self.columns * self.square, self.rows * self.square

    @cached_property
    def _board(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square, self.marker, dictionary
        )

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._board)

    @cached_property
    def corners(self) -> Floats:
        """((columns - 1) (rows - 1), 3) inner corners in the board's frame, by their number [m]."""
        width, height = self.size
        flat = np.asarray(self._board.getChessboardCorners(), dtype=np.float64)
        # OpenCV counts from the pattern's top left, y downwards.
        return np.column_stack(
            [flat[:, 0] - width / 2.0, height / 2.0 - flat[:, 1], np.zeros(len(flat))]
        )

    def picture(self, pixels_per_square: int = 100) -> Image:
        """The pattern without a margin, (rows, columns) times `pixels_per_square`, grey."""
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        return np.asarray(self._board.generateImage(size, marginSize=0), dtype=np.uint8)

    def find(self, image: Image) -> View | None:
        """Its corners in a picture, (height, width) or (height, width, 3) BGR; None: too few."""
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        pixels, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < FEWEST:
            return None
        numbers: NDArray[np.intp] = ids.ravel().astype(np.intp)
        return View(self.corners[numbers], pixels.reshape(-1, 2).astype(np.float64))
