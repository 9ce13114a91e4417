"""Pictures of runs."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from codesign_policy.curves import draw_curves, moving_mean, read_history


def test_a_moving_mean_of_what_is_known() -> None:
    values = np.array([np.nan, 2.0, 4.0, np.nan, 6.0, 8.0])
    np.testing.assert_allclose(moving_mean(values, 3), [np.nan, 2.0, 3.0, 3.0, 5.0, 7.0])


def test_curves_of_a_history_with_gaps(tmp_path: Path) -> None:
    text = "round,transitions,episode_return,success,top10_stress\n1,10,-3,0,\n2,20,5,1,900\n"
    (tmp_path / "history.csv").write_text(text)
    history = read_history(tmp_path)
    np.testing.assert_array_equal(history["top10_stress"], [np.nan, 900.0])
    draw_curves({"a": history, "b": history}, tmp_path / "curves.png")
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.size == (1210, 704)


def test_a_folder_without_a_history_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no history\.csv"):
        read_history(tmp_path)
