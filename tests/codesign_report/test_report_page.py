"""The page, the summary and the commands that make them."""

import dataclasses
import html.parser
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import typer
from synthetic_trial import DOMAIN, SyntheticTrial, write_bag
from typer.testing import CliRunner

import codesign_report
from codesign_cli import bag as bag_commands
from codesign_cli import report as commands
from codesign_report import BagError, SkippedBag, TrialResult, trial_metrics, write_report
from codesign_report.charts import BOTTOM, LEFT, RIGHT, TOP, Chart, Series, draw, limits
from codesign_report.portrait import finger_portrait
from codesign_report.report import data_uri, number
from codesign_report.video import write_video

SIZE = (64, 48)
VOID = {"meta", "img", "input", "br", "link", "path", "rect"}


@pytest.fixture(scope="module")
def result(recording, tmp_path_factory):
    folder = tmp_path_factory.mktemp("video")
    video = write_video(recording, folder / "stock-seed3.mp4", width=64, height=48, fps=2)
    return TrialResult(recording, trial_metrics(recording), video)


@pytest.fixture(scope="module")
def page(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    return write_report([result], path).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of two grippers, one of them twice, and a broken bag; already built."""
    folder = tmp_path_factory.mktemp("demo")
    for gripper, seed in (("stock", 0), ("round", 0), ("round", 1)):
        trial = SyntheticTrial(gripper=gripper, seed=seed, duration=1.5, cells=(2, 3, 2))
        write_bag(folder / f"{gripper}-seed{seed}", trial)
    (folder / "logs").mkdir()
    broken = folder / "stock-seed9"
    shutil.copytree(folder / "stock-seed0", broken)
    (broken / "stock-seed9.mcap").write_bytes(b"")
    for old in broken.glob("stock-seed0*"):
        old.unlink()
    seen = []
    report = codesign_report.build(folder, progress=lambda *step: seen.append(step), size=SIZE)
    return folder, report, seen


class Outline(html.parser.HTMLParser):
    """Tags that open and close in order, and every attribute."""

    def __init__(self):
        super().__init__()
        self.open, self.attributes, self.crossed = [], [], []

    def handle_starttag(self, tag, attributes):
        self.attributes += [(tag, *a) for a in attributes]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.attributes += [(tag, *a) for a in attributes]

    def handle_endtag(self, tag):
        if self.open.pop() != tag:
            self.crossed.append(tag)


def outline(page):
    parser = Outline()
    parser.feed(page)
    return parser


def renamed(result, **changes):
    return dataclasses.replace(result, recording=dataclasses.replace(result.recording, **changes))


def test_the_numbers_are_on_the_page(page, result):
    metrics = result.metrics
    for text in (
        number(metrics.top10_stress),
        number(metrics.median_stress),
        number(1e3 * metrics.peak_lift, 1),
        f"{number(metrics.held_force, 3)} / {number(result.recording.weight, 3)}",
        number(metrics.score, 1),
        "9.00",
        "0.310",
        "0.50",
        "50 × 40 mm",
        "✓ picked up",
    ):
        assert text in page


def test_units_and_definitions_are_on_the_page(page):
    for text in ("kPa", "kg/m³", "[Pa]", "[N]", "[mm]", "equation 2", "80 mm", "0.02 N"):
        assert text in page


def test_the_page_is_well_formed_and_self_contained(page):
    parser = outline(page)
    assert parser.crossed == []
    assert parser.open == []
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", page).replace("http-equiv", "")
    for tag, name, value in parser.attributes:
        if name in ("src", "href", "poster", "action", "data"):
            assert value.startswith(("data:", "#")), (tag, name)
    assert "@import" not in page
    assert "default-src 'none'" in page


def test_the_video_is_inside(page, result):
    videos = [v for tag, name, v in outline(page).attributes if (tag, name) == ("video", "src")]
    assert len(videos) == 1
    assert videos[0].startswith("data:video/mp4;base64,")
    assert len(videos[0]) == pytest.approx(result.video.stat().st_size * 4 / 3, rel=0.01)


def test_pictures_have_words(page):
    attributes = outline(page).attributes
    labels = [v for tag, name, v in attributes if (tag, name) == ("svg", "aria-label")]
    assert len(labels) == 4
    assert labels[0].startswith("Von Mises stress over time: top 10 % from ")
    assert any((tag, name) == ("video", "aria-label") for tag, name, _ in attributes)


def test_labels_from_a_bag_cannot_inject(result, tmp_path):
    evil = renamed(result, gripper='<script>alert("1")</script>')
    page = write_report([evil], tmp_path / "r.html").read_text()
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


def test_same_seed_stands_side_by_side(result, tmp_path):
    trials = [
        result,
        renamed(result, gripper="round", bag=Path("round-seed3")),
        renamed(result, gripper="round", bag=Path("round-seed4"), seed=4),
    ]
    page = write_report(trials, tmp_path / "r.html").read_text()
    assert page.index("Seed 3</h2>") < page.index("Seed 4</h2>")
    assert page.count(">Play</button>") == 1
    assert page.count('class="card trial solo"') == 1
    assert "By gripper" in page
    assert "<h1>round against stock</h1>" in page
    assert page.count("1.00 ×</b>") == 2  # of its own copy's stresses


def test_grippers_on_the_same_seed_share_charts(result, tmp_path):
    trials = [result, renamed(result, gripper="round", bag=Path("round-seed3"))]
    portraits = {"round": b"round fingers", "stock": b"stock fingers"}
    page = write_report(trials, tmp_path / "r.html", portraits=portraits).read_text()
    parser = outline(page)
    assert parser.crossed == []
    labels = [v for tag, name, v in parser.attributes if (tag, name) == ("svg", "aria-label")]
    assert len(labels) == 4
    for curve in ("round, top 10 %", "stock, top 10 %", "round, median", "stock, median"):
        assert curve in labels[0]
    pictures = [v for tag, name, v in parser.attributes if (tag, name) == ("img", "src")]
    assert pictures == [data_uri("image/jpeg", portraits[n]) for n in ("round", "stock")]
    drawn = [v for tag, name, v in parser.attributes if (tag, name) == ("path", "class")]
    assert {"line c0 d0", "line c0 d1", "line c1 d0", "line c1 d1"} <= set(drawn)
    # One player for all videos of the seed, no controls of their own.
    assert page.count('class="player"') == 1
    assert not any((tag, name) == ("video", "controls") for tag, name, _ in parser.attributes)


def test_a_portrait_shows_both_fingers_and_the_object(recording):
    """Blue fingers left and right of a pale object."""
    import io

    from PIL import Image

    picture = Image.open(io.BytesIO(finger_portrait(recording, 320, 184)))
    assert picture.size == (320, 184)
    red, _, blue = np.moveaxis(np.asarray(picture, dtype=int), -1, 0)
    columns = np.flatnonzero((blue - red > 30).sum(axis=0) > 20)
    pale = np.flatnonzero((red - blue > 10).sum(axis=0) > 20)
    assert columns.min() < pale.min() < pale.max() < columns.max()


def test_a_trial_without_contact(result, tmp_path):
    stress = result.recording.stress
    nothing = np.zeros_like(stress.left_force)
    recording = dataclasses.replace(
        result.recording,
        stress=dataclasses.replace(stress, left_force=nothing, right_force=nothing),
    )
    failed = TrialResult(recording, trial_metrics(recording))
    page = write_report([failed], tmp_path / "r.html").read_text()
    assert "✗ not picked up" in page
    assert "nan" not in page.lower().replace("nano", "")
    text = codesign_report.write_summary([failed], tmp_path / "s.json").read_text()
    (entry,) = json.loads(text, parse_constant=pytest.fail)["trials"]
    assert entry["top10_stress_pa"] is None
    assert entry["success"] is False
    assert entry["video"] is None


def test_no_trials(tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        write_report([], tmp_path / "r.html")


def test_a_failed_write_keeps_the_old_page(result, tmp_path, monkeypatch):
    path = tmp_path / "r.html"
    path.write_text("old")

    def full(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space"):
        write_report([result], path)
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_numbers_for_people():
    assert number(12345.6) == "12\u202f346"
    assert number(-0.5, 1) == "\u22120.5"
    assert number(math.nan) == "–"


def test_a_chart_is_to_scale():
    times = np.array([0.0, 1.0, 2.0])
    chart = Chart("Lift", "mm", [Series("a", times, np.array([0.0, 50.0, 100.0]))])
    assert limits([chart]) == (0.0, 100.0)
    drawing = draw(chart, 0.0, 2.0, (0.0, 100.0))
    middle = f"{(LEFT + RIGHT) / 2},{(TOP + BOTTOM) / 2}"
    assert drawing.curves[0].path == f"M{LEFT}.0,{BOTTOM}.0L{middle}L{RIGHT}.0,{TOP}.0"


def test_charts_show_negative_values():
    times = np.array([0.0, 1.0])
    chart = Chart("Force", "N", [Series("a", times, np.array([-2.0, 4.0]))])
    assert limits([chart]) == (-2.0, 4.0)
    (_, lowest), *_ = draw(chart, 0.0, 1.0, (-2.0, 4.0)).y_ticks
    assert lowest == "−2"


# -- building a run ------------------------------------------------------------------------------


def test_build_writes_everything(run):
    folder, report, _ = run
    names = {"round-seed0.mp4", "round-seed1.mp4", "stock-seed0.mp4", "report.html", "summary.json"}
    assert {p.name for p in folder.iterdir() if p.is_file()} == names
    assert [r.recording.name for r in report.trials] == [
        "round-seed0",
        "round-seed1",
        "stock-seed0",
    ]
    assert (report.page, report.summary) == (folder / "report.html", folder / "summary.json")


def test_build_says_what_it_left_out(run):
    folder, report, _ = run
    (skipped,) = report.skipped
    assert skipped.bag == folder / "stock-seed9"
    assert "Left out:" in report.page.read_text()
    assert json.loads(report.summary.read_text())["skipped"][0]["bag"] == "stock-seed9"


def test_summary(run):
    folder, report, _ = run
    trials = json.loads(report.summary.read_text())["trials"]
    assert [(t["gripper"], t["seed"]) for t in trials] == [("round", 0), ("round", 1), ("stock", 0)]
    for entry, result in zip(trials, report.trials, strict=True):
        assert entry["success"] is result.metrics.success
        assert entry["top10_stress_pa"] == result.metrics.top10_stress
        assert entry["median_stress_pa"] == result.metrics.median_stress
        assert entry["peak_lift_m"] == result.metrics.peak_lift
        assert entry["weight_n"] == pytest.approx(result.recording.weight)
        assert (folder / entry["bag"] / "metadata.yaml").exists()
        assert (folder / entry["video"]).exists()
        assert entry["domain"]["young_modulus_pa"] == DOMAIN["young_modulus"]


def test_summary_of_grippers(run):
    _, report, _ = run
    around, stock = json.loads(report.summary.read_text())["grippers"]
    assert (around["gripper"], around["trials"], around["baseline"]) == ("round", 2, "stock")
    assert around["top10_ratio"] == pytest.approx(1.0)  # the same made-up trial
    assert (stock["gripper"], stock["trials"], stock["baseline"]) == ("stock", 1, None)
    assert stock["top10_ratio"] is None


def test_progress_goes_from_start_to_end(run):
    _, report, seen = run
    done, totals, names = zip(*seen, strict=True)
    assert list(done) == list(range(1, totals[0] + 1))
    assert set(totals) == {len(seen)}
    assert list(dict.fromkeys(names)) == [r.recording.name for r in report.trials]


def test_two_processes_make_the_same(run, tmp_path):
    _, report, _ = run
    seen = []
    bags = [r.recording.bag for r in report.trials]
    again = codesign_report.build(
        tmp_path, bags, lambda *step: seen.append(step), size=SIZE, processes=2
    )
    for one, other in zip(report.trials, again.trials, strict=True):
        assert repr(one.metrics) == repr(other.metrics)  # NaN equals nothing
        assert one.video.read_bytes() == other.video.read_bytes()
    done, totals, words = zip(*seen, strict=True)
    assert list(done) == sorted(done)
    assert done[-1] == totals[-1]
    assert words[-1] == "3 of 3 videos done"


def test_a_video_that_fails_in_its_process_is_an_error(run, tmp_path):
    _, report, _ = run
    (tmp_path / "round-seed0.mp4").mkdir()
    with pytest.raises(OSError, match="round-seed0"):
        codesign_report.build(
            tmp_path, [r.recording.bag for r in report.trials], size=SIZE, processes=2
        )


def test_build_of_chosen_bags(run, tmp_path):
    folder, _, _ = run
    report = codesign_report.build(tmp_path, [folder / "round-seed1"], size=SIZE)
    assert [r.recording.seed for r in report.trials] == [1]
    bag = json.loads(report.summary.read_text())["trials"][0]["bag"]
    assert (tmp_path / bag).resolve() == (folder / "round-seed1").resolve()


def test_build_refuses(run, tmp_path):
    folder, _, _ = run
    with pytest.raises(BagError, match="no trial bags"):
        codesign_report.build(tmp_path)
    with pytest.raises(BagError, match="not a folder"):
        codesign_report.build(tmp_path / "nothing")
    with pytest.raises(BagError, match="stock-seed9"):
        codesign_report.build(tmp_path, [folder / "stock-seed9"])
    twice = [folder / "round-seed1"] * 2
    with pytest.raises(ValueError, match="two bags are named round-seed1"):
        codesign_report.build(tmp_path, twice)


def test_skipped_bags_without_a_summary_path_above(tmp_path, result):
    path = codesign_report.write_summary(
        [result], tmp_path / "s.json", [SkippedBag(tmp_path / "x", "broken")]
    )
    assert json.loads(path.read_text())["skipped"] == [{"bag": "x", "reason": "broken"}]


# -- commands ------------------------------------------------------------------------------------


def invoke(*arguments):
    app = typer.Typer()
    app.add_typer(bag_commands.app, name="bag")
    app.command("report")(commands.report)
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_bag_metrics(bag, recording):
    metrics = trial_metrics(recording)
    shown = invoke("bag", "metrics", bag)
    assert shown.exit_code == 0
    assert f"{metrics.top10_stress:.0f} Pa" in shown.stdout
    values = json.loads(invoke("bag", "metrics", bag, "--json").stdout)
    assert values["top10_stress"] == metrics.top10_stress
    assert (values["gripper"], values["seed"], values["success"]) == ("stock", 3, True)


def test_report_command(run, tmp_path):
    folder, _, _ = run
    shutil.copytree(folder / "round-seed1", tmp_path / "round-seed1")
    shown = invoke("report", tmp_path, "--json")
    assert shown.exit_code == 0
    assert json.loads(shown.stdout) == json.loads((tmp_path / "summary.json").read_text())
    assert (tmp_path / "report.html").exists()


@pytest.mark.parametrize("command", [("bag", "metrics"), ("report",)])
def test_bad_input_is_one_line_and_exit_code_2(command, tmp_path):
    shown = invoke(*command, tmp_path / "nothing")
    assert shown.exit_code == 2
    assert shown.stderr.startswith("error: ")
    assert shown.stderr.count("\n") == 1
    assert "nothing" in shown.stderr
