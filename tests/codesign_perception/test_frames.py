"""Which pictures are believed."""

import numpy as np

from codesign_perception.frames import FrameGate, decode, encode

SECOND = 1_000_000_000


def picture(seed: int) -> bytes:
    rng = np.random.default_rng(seed)
    return encode(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))


def test_fresh_pictures_pass_and_decode() -> None:
    gate = FrameGate()
    for i in range(5):
        data = picture(i)
        assert gate.objection(i * SECOND, i * SECOND + 10_000_000, data) == ""
        assert gate.decoded(data).shape == (48, 64, 3)
    assert not gate.counts


def test_a_hanging_camera_is_noticed_at_the_third_equal_picture() -> None:
    gate = FrameGate()
    data = picture(0)
    reasons = [gate.objection(i, i, data) for i in range(4)]
    assert reasons[:2] == ["", ""]
    assert "3 equal pictures" in reasons[2]
    assert gate.frozen
    assert gate.objection(10, 10, picture(1)) == ""
    assert not gate.frozen
    assert gate.counts["frozen"] == 2


def test_the_same_picture_sent_again_is_no_hanging_camera() -> None:
    gate = FrameGate()
    assert [gate.objection(7, 7, picture(0)) for _ in range(5)] == [""] * 5


def test_stale_future_and_disordered_pictures() -> None:
    gate = FrameGate(max_age=0.2)
    assert "0.30 s old" in gate.objection(SECOND, SECOND + 300_000_000, picture(0))
    assert "-0.30 s old" in gate.objection(SECOND, SECOND - 300_000_000, picture(0))
    assert gate.objection(SECOND, SECOND, picture(1)) == ""
    assert "older than the one before" in gate.objection(SECOND - 1, SECOND, picture(2))
    assert gate.counts["stale"] == 3
    # A clock that was set back by far is a new clock.
    assert gate.objection(-49 * SECOND, -49 * SECOND, picture(3)) == ""


def test_empty_and_damaged_pictures() -> None:
    gate = FrameGate()
    assert "empty" in gate.objection(0, 0, b"")
    data = picture(0)
    for bad in (data[: len(data) // 2], b"\x00" * 500, data[:2], b"\xff\xd8" + b"\x11" * 300):
        assert gate.decoded(bad) is None
    assert gate.counts == {"empty": 1, "corrupt": 4}


def test_png_decodes_too() -> None:
    import cv2

    image = np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3)
    np.testing.assert_array_equal(decode(cv2.imencode(".png", image)[1].tobytes()), image)
