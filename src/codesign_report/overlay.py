"""Text and colour bar on top of a rendered picture."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image as Picture
from PIL import ImageDraw, ImageFont

from codesign_report.scene import color_table

Image = npt.NDArray[np.uint8]

INK = (28, 36, 46)
SOFT_INK = (88, 100, 114)


class Overlay:
    """A colour bar at the right and a text block at the top left, scaled with the picture.

    Args:
        width, height: of the picture [px].
        stress_max: von Mises stress at the upper end of the colour bar [Pa]; the lower end is 0.
        title: of the text block.
    """

    def __init__(self, width: int, height: int, stress_max: float, title: str) -> None:
        self._scale = height / 720.0
        self._title = title
        self._box = (round(24 * self._scale), round(20 * self._scale))
        self._bar = self._draw_bar(height, stress_max)
        # Text stays left of the colour bar on narrow pictures.
        self._text_width = min(round(430 * self._scale), width - self._bar.width)

    def draw(self, picture: Image, rows: Sequence[tuple[str, str]]) -> Image:
        """Draw label and value pairs and the colour bar onto the picture, in place."""
        self._paste(picture, self._bar, picture.shape[1] - self._bar.width, 0)
        left, top = self._box
        self._paste(picture, self._draw_text(rows), left, top)
        return picture

    def _paste(self, picture: Image, part: Any, left: int, top: int) -> None:
        """Blend an RGBA part over the picture."""
        over = np.asarray(part, dtype=np.uint16)
        view = picture[top : top + over.shape[0], left : left + over.shape[1]]
        over = over[: view.shape[0], : view.shape[1]]
        alpha = over[..., 3:]
        view[:] = (over[..., :3] * alpha + view * (255 - alpha) + 127) // 255

    def _draw_text(self, rows: Sequence[tuple[str, str]]) -> Any:
        line = round(27 * self._scale)
        size = (self._text_width, round(38 * self._scale) + line * len(rows))
        text = Picture.new("RGBA", size, (236, 239, 242, 0))
        draw = ImageDraw.Draw(text)
        draw.text((0, 0), self._title, fill=INK, font=_font(22 * self._scale, bold=True))
        label_font, value_font = _font(17 * self._scale), _font(17 * self._scale, bold=True)
        for i, (label, value) in enumerate(rows):
            y = round(36 * self._scale) + i * line
            draw.text((0, y), label, fill=SOFT_INK, font=label_font)
            draw.text((round(150 * self._scale), y), value, fill=INK, font=value_font)
        return text

    def _draw_bar(self, height: int, stress_max: float) -> Any:
        s = self._scale
        bar = Picture.new("RGBA", (round(150 * s), height), (236, 239, 242, 0))
        draw = ImageDraw.Draw(bar)
        top, bottom = round(110 * s), height - round(70 * s)
        left, wide = round(34 * s), round(22 * s)
        label = _font(16 * s)
        draw.text((0, round(44 * s)), "von Mises\nstress [Pa]", fill=INK, font=label, spacing=2)
        ramp = np.round(255.0 * color_table()[::-1]).astype(np.uint8)[:, None]
        strip = Picture.fromarray(ramp, "RGB").resize((wide, bottom - top))
        bar.paste(strip, (left, top))
        draw.rectangle((left, top, left + wide, bottom), outline=INK, width=max(1, round(s)))
        for i, tick in enumerate(nice_ticks(stress_max)):
            y = bottom - (bottom - top) * tick / stress_max
            draw.line((left + wide, y, left + wide + 5 * s, y), fill=INK, width=max(1, round(s)))
            # The last colour also stands for everything above it.
            text = ("≥ " if tick == stress_max and i else "") + f"{tick:,.0f}".replace(",", " ")
            draw.text((left + wide + 9 * s, y), text, fill=INK, font=label, anchor="lm")
        return bar


def nice_ticks(maximum: float, most: int = 6) -> list[float]:
    """Round tick values from 0 to `maximum`, which is always one of them."""
    step = _round_up(maximum / (most - 1), (1.0, 2.0, 2.5, 5.0, 10.0))
    ticks = np.arange(0.0, maximum - 0.5 * step, step).tolist()
    return [*ticks, maximum]


def nice_ceiling(value: float) -> float:
    """The next number of the series 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten."""
    return _round_up(value, (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0))


def _round_up(value: float, steps: tuple[float, ...]) -> float:
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(s for s in steps if s >= value / power - 1e-9))


@cache
def _font(size: float, bold: bool = False) -> Any:
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf" / name), size)
