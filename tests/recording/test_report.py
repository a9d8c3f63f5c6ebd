"""``skyloop log report``: one self-contained page that shows the flight."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import Feedback
from skyloop.recording.reader import Recording
from skyloop.recording.review import charts
from skyloop.recording.review import report as facts
from skyloop.recording.review.charts import spans
from skyloop.recording.review.report import write_report
from skyloop.recording.review.tables import Table
from tests.support.commands import Ended
from tests.support.recorded_flights import Plan, feedback_at, write_flight

Log = Callable[..., Ended]


class Checker(HTMLParser):
    """Records tags, and reports those not closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in {"meta", "img", "br"}:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def checked(page: str) -> Checker:
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    return checker


@pytest.fixture(scope="module")
def page(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(Recording.open(flight), "alpha", path)
    return path.read_text()


def test_it_is_one_complete_page(page: str) -> None:
    tags = checked(page).tags
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)
    assert "@import" not in page
    assert "url(" not in page
    pictures = [attributes["src"] for tag, attributes in tags if tag == "img"]
    assert len(pictures) == 8
    assert all(str(source).startswith("data:image/jpeg;base64,") for source in pictures)
    assert "prefers-color-scheme: dark" in page


def test_it_shows_everything(page: str) -> None:
    titles = re.findall(r"<h[23]>([^<]+)", page)
    assert [title.strip() for title in titles] == [
        "Path",
        "From above",
        "From the side",
        "Course",
        "Altitude",
        "Roll and pitch",
        "Yaw",
        "Velocity",
        "Battery",
        "Delays",
        "Logged by applications",
        "Key frames of front",
        "Events",
        "Channels",
    ]
    figures = dict(re.findall(r"<dt>([^<]+)</dt><dd>([^<]+)</dd>", page))
    assert figures == {
        "recorded": "2.0 s",
        "in the air": "1.7 s",
        "highest": "1.20 m",
        "fastest": "0.41 m/s",
        "distance": "2.4 m",
        "battery": "100% → 90%",
        "commands": "40",
        "frames": "20",
    }
    for words in ("taking off", "landing", "pilot.py", "touched a chair", "forward set", "age of front frames"):
        assert words in page, words


def test_the_numbers_for_the_cursor(page: str) -> None:
    text = re.search(r'<script type="application/json" id="data">(.+?)</script>', page)
    assert text is not None
    data = json.loads(text[1])
    assert data["end"] == pytest.approx(1.98, abs=0.02)
    heads = {name: page.split(f'data-chart="{name}"')[1].split("</header>", maxsplit=1)[0] for name in data["charts"]}
    legends = {name: head.count("<li") for name, head in heads.items()}
    assert legends == {name: len(series) for name, series in data["charts"].items()}
    times, heights = data["charts"]["chart0"][0]
    assert len(times) == len(heights) == 96
    assert max(heights) == pytest.approx(1.2)
    assert len(data["way"]) == 3


def test_the_command(log: Log, flight: Path, tmp_path: Path) -> None:
    target = tmp_path / "page.html"
    ended = log("report", flight, "-o", target, "--pictures", "0")
    assert (ended.code, ended.out) == (0, "")
    assert f"{target}: " in ended.err
    assert "<img" not in target.read_text()
    assert "can't be written" in log("report", flight, "-o", tmp_path / "nowhere" / "x.html").err
    assert "did you mean 'alpha'" in log("report", flight, "--drone", "alhpa").err


def test_a_recording_of_only_images_and_one_without_known_values(tmp_path: Path) -> None:
    def blind(at_ms: int) -> Feedback:
        return Feedback(captured_ns=feedback_at(Plan(), at_ms, 1).captured_ns, published_ns=0)

    path = write_flight(tmp_path / "blind.mcap", Plan(seconds=0.5, extra=blind, lossy=False, frame_ms=0, command_ms=0))
    write_report(Recording.open(path), "alpha", tmp_path / "blind.html")
    text = (tmp_path / "blind.html").read_text()
    checked(text)
    assert "<h2>Path</h2>" not in text
    assert "Altitude" not in text


def test_a_cut_recording_says_so(tmp_path: Path, flight: Path) -> None:
    path = tmp_path / "cut.mcap"
    data = flight.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    write_report(Recording.open(path), "alpha", tmp_path / "cut.html")
    text = (tmp_path / "cut.html").read_text()
    assert 'class="note">cut off: it ends within a record' in text


def test_names_do_no_harm(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "x.mcap", Plan(seconds=0.5, drone="<script>alert(1)</script>"))
    recording = Recording.open(path)
    write_report(recording, recording.drone().name, tmp_path / "x.html")
    assert "<script>alert" not in (tmp_path / "x.html").read_text()


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node to check the page's script")
def test_the_script_is_valid(tmp_path: Path) -> None:
    script = Path(charts.__file__).parent / "static" / "page.js"
    node = shutil.which("node")
    assert node is not None
    subprocess.run([node, "--check", str(script)], check=True, timeout=20)


# Parts -------------------------------------------------------------------------------------------------------------


@given(low=st.floats(-1e4, 1e4), span=st.floats(1e-3, 1e4), most=st.integers(2, 12))
def test_ticks_are_round_and_within(low: float, span: float, most: int) -> None:
    found = charts.ticks(low, low + span, most)
    assert len(found) <= most + 2
    assert all(low - 1e-6 * span <= tick <= low + span * (1 + 1e-6) for tick in found)
    steps = {round(b - a, 9) for a, b in pairwise(found)}
    for step in steps:
        mantissa = step / 10 ** math.floor(math.log10(step) + 1e-9)
        assert min(abs(mantissa - round_one) for round_one in (1.0, 2.0, 5.0)) < 1e-3


@given(st.lists(st.floats(-1e3, 1e3) | st.just(math.nan), min_size=1, max_size=400), st.integers(2, 50))
def test_thinning_keeps_the_extremes(values: list[float], buckets: int) -> None:
    numbers = np.array(values)
    t_s, thin = charts.thin(np.arange(len(numbers), dtype=float), numbers, buckets)
    assert len(t_s) == len(thin) <= max(2 * buckets, len(numbers) if len(numbers) <= 2 * buckets else 0)
    assert np.all(np.diff(t_s) > 0)
    if np.isfinite(numbers).any():
        assert np.nanmax(thin) == np.nanmax(numbers)
        assert np.nanmin(thin) == np.nanmin(numbers)


def test_lines_have_gaps_at_unknown_values() -> None:
    t_s = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 5.0, 5.1])
    values = np.array([1.0, 2.0, math.nan, 3.0, 4.0, 5.0, 6.0])
    assert [part[1].tolist() for part in charts.pieces(t_s, values)] == [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]
    assert charts.pieces(np.zeros(0), np.zeros(0)) == []


def test_limits() -> None:
    line = charts.Line("x", np.arange(3.0), np.array([2.0, 3.0, math.nan]))
    low, high = charts.limits([line], least_span=4.0)
    assert (low, high) == pytest.approx((0.26, 4.74))
    assert charts.limits([line], least_span=4.0, zero=True) == pytest.approx((0.0, 4.24))
    assert charts.limits([], least_span=1.0) == (0.0, 1.0)


def test_key_frames_are_at_events_and_between_them() -> None:
    events = Table(
        "events",
        {
            "t_s": np.array([1.0, 4.0, 4.1]),
            "kind": np.array(["state_changed", "collision", "vehicle_message"]),
            "severity": np.array(["info", "warning", "info"]),
            "text": np.array(["took off", "touched a chair", "hello"]),
        },
    )
    chosen = facts.moments(0.0, 10.0, events, 6)
    assert [(round(t, 1), why) for t, why in chosen] == [
        (0.0, ""),
        (1.0, "took off"),
        (2.0, ""),
        (4.0, "touched a chair"),
        (6.0, ""),
        (8.0, ""),
    ]
    assert facts.moments(0.0, 10.0, None, 3) == [(0.0, ""), (5.0, ""), (10.0, "")]
    assert facts.moments(0.0, 10.0, events, 0) == []


def test_the_path_without_a_position() -> None:
    t_s = np.arange(0.0, 2.0, 0.1)
    columns = {"t_s": t_s, "velocity_forward_m_s": np.full(20, 0.5), "velocity_left_m_s": np.zeros(20)}
    columns["yaw_rad"] = np.full(20, math.pi / 2)
    way = facts.way_of(Table("feedback", columns))
    assert way is not None
    assert "drifts" in way.source
    assert way.length_m == pytest.approx(0.95)
    assert way.y[-1] == pytest.approx(0.95)
    assert abs(way.x[-1]) < 1e-9
    truth = {"native.truth.x": t_s, "native.truth.y": np.zeros(20)}
    known = facts.way_of(Table("feedback", columns | truth))
    assert known is not None
    assert "simulator" in known.source
    assert facts.way_of(Table("feedback", {"t_s": t_s})) is None


def test_stretches_of_one_name() -> None:
    names = np.array(["a", "a", "", "b_c", "b_c"])
    found = spans(np.arange(5.0), names, {"a": "", "*": "flying"}, 6.0)
    assert [(span.begin_s, span.end_s, span.text) for span in found] == [(3.0, 6.0, "b c")]
    assert spans(np.zeros(0), np.array([], dtype=np.str_), {}, 1.0) == []


def test_without_an_image_decoder_thumbnails_are_as_recorded(flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    picture = next(Recording.open(flight).pictures("alpha", "front"))
    monkeypatch.setitem(sys.modules, "cv2", None)
    data, form = facts.thumbnail(picture)
    assert (data[:2], form) == (b"\xff\xd8", "jpeg")
