"""Videos decode, last as long as the trial and show the right thing."""

import dataclasses

import av
import numpy as np
import pytest

from codesign_report.overlay import Overlay, nice_ceiling, nice_ticks
from codesign_report.scene import stress_color
from codesign_report.video import Encoder, frame_count, stress_ceiling, write_video

SIZE = {"width": 320, "height": 180}


@pytest.fixture(scope="module")
def video(recording, tmp_path_factory):
    return write_video(recording, tmp_path_factory.mktemp("video") / "stock.mp4", **SIZE, fps=10)


def decode(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_duration_size_and_format(video, recording):
    duration = recording.motion.times[-1] - recording.motion.times[0]
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.width, context.height) == (320, 180)
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        assert (context.colorspace, context.color_range) == (1, 1)
        assert float(stream.average_rate) == 10.0
        assert container.duration / av.time_base == pytest.approx(duration, abs=0.11)
    assert len(decode(video)) == frame_count(recording, 10) == int(10 * duration + 1e-6) + 1


def test_the_index_is_in_front(video):
    data = video.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_the_picture_follows_the_trial(video):
    frames = decode(video)
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 2.0
    for frame in frames:
        assert frame.std() > 15


def test_the_object_stays_in_the_picture(video):
    for frame in decode(video)[::6]:
        r, g, b = np.moveaxis(frame[20:170, 90:230].astype(int), -1, 0)
        warm = (r - b > 50) & (r > g - 5)
        rows, columns = np.nonzero(warm)
        assert warm.sum() > 800
        assert 30 < rows.mean() < 130
        assert 40 < columns.mean() < 100


def test_progress_counts_pictures(recording, tmp_path):
    seen = []
    write_video(
        recording, tmp_path / "v.mp4", width=64, height=48, fps=2,
        progress=lambda done, total: seen.append((done, total)),
    )  # fmt: skip
    total = frame_count(recording, 2)
    assert seen == [(i + 1, total) for i in range(total)]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"width": 321}, "even"), ({"fps": 0}, "fps is 0"), ({"stress_max": -1.0}, "stress_range")],
)
def test_bad_arguments_are_named_and_leave_nothing(recording, tmp_path, kwargs, message):
    with pytest.raises(ValueError, match=message):
        write_video(recording, tmp_path / "v.mp4", **{**SIZE, **kwargs})
    assert list(tmp_path.iterdir()) == []


def test_wrong_stamps_do_not_fill_the_disk(recording, tmp_path):
    times = recording.motion.times.copy()
    times[-1] = 1.7e9
    motion = dataclasses.replace(recording.motion, times=times)
    with pytest.raises(ValueError, match=r"lasts 1700000000 s"):
        write_video(dataclasses.replace(recording, motion=motion), tmp_path / "v.mp4")


def test_a_failure_keeps_the_old_video(recording, tmp_path):
    target = tmp_path / "v.mp4"
    target.write_bytes(b"old")

    def stop(done, _):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(recording, target, width=64, height=48, fps=2, progress=stop)
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_colours_survive_encoding(tmp_path):
    colors = [stress_color(v, (0.0, 1.0)) for v in (0.0, 0.3, 0.6, 1.0)]
    picture = np.repeat(np.array(colors, dtype=np.uint8)[:, None], 64, axis=1)
    picture = np.repeat(picture, 16, axis=0)
    with Encoder(tmp_path / "c.mp4", 64, 64, 10) as encoder:
        for _ in range(5):
            encoder.add(picture)
    with av.open(str(tmp_path / "c.mp4")) as container:
        frame = list(container.decode(video=0))[-1]
    shown = frame.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray()
    for i, color in enumerate(colors):
        np.testing.assert_allclose(shown[16 * i + 8, 32], color, atol=6)


def test_the_colour_bar_is_the_map():
    picture = np.full((720, 1280, 3), 240, dtype=np.uint8)
    Overlay(1280, 720, 4000.0, "stock").draw(picture, [("Time", "1.0 s")])
    column = picture[112:648, 1280 - 150 + 45].astype(int)
    for share in (0.1, 0.5, 0.9):
        seen = column[round((1.0 - share) * (len(column) - 1))]
        np.testing.assert_allclose(seen, stress_color(share, (0.0, 1.0)), atol=8)
    assert (picture[20:80, 24:200] < 100).any()


@pytest.mark.parametrize(
    ("value", "expected"), [(990.0, 1000.0), (1001.0, 1500.0), (0.61, 0.8), (0.0, 1.0), (8e3, 8e3)]
)
def test_round_numbers(value, expected):
    assert nice_ceiling(value) == pytest.approx(expected)


def test_ticks_end_at_the_maximum():
    assert nice_ticks(4000.0) == [0.0, 1000.0, 2000.0, 3000.0, 4000.0]
    assert nice_ticks(1500.0) == [0.0, 500.0, 1000.0, 1500.0]


def test_one_scale_for_all(recording):
    stress = dataclasses.replace(recording.stress, top10=recording.stress.top10 * 2.0)
    harder = dataclasses.replace(recording, stress=stress)
    assert stress_ceiling([recording, harder]) == stress_ceiling([harder])
    assert stress_ceiling([harder]) >= stress.top10.max()
