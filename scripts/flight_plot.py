"""A flight's figures as an SVG: true distance to the marker over time, and both paths from above. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from skyloop.messages import Feedback

WIDTH, HEIGHT = 960, 380
INK, FAINT, GRID = "#24292f", "#6e7781", "#e3e6ea"
DRONE, BOARD, WANTED = "#1f6feb", "#d9730d", "#2da44e"
ROOM_M = (8.0, 6.0)  # of the world ``room``, from west to east and from south to north
EVERY_S = 0.1  # between the points drawn
Point = tuple[float, float]


@dataclass(slots=True)
class FlightLog:
    """True places of vehicle and board, from a simulated vehicle's telemetry. World axes [m]."""

    wanted_m: float
    found_ns: int = 0  #: capture of the first frame that showed the marker
    places: list[tuple[int, tuple[float, ...], tuple[float, ...]]] = field(default_factory=list)

    def add(self, feedback: Feedback) -> None:
        """Add a sample; samples closer together than points are skipped."""
        native = feedback.native
        if native is None or (self.places and feedback.captured_ns - self.places[-1][0] < EVERY_S * 1e9):
            return
        own, board = (
            tuple(float(native[f"truth.{whose}{axis}"]) for axis in "xyz")  # type: ignore[arg-type]
            for whose in ("", "target.")
        )
        self.places.append((feedback.captured_ns, own, board))

    def ranges(self) -> list[Point]:
        """Return the time since the first sample [s] and the distance between vehicle and board [m]."""
        begin = self.places[0][0]
        return [((at_ns - begin) / 1e9, math.dist(own, board)) for at_ns, own, board in self.places]


@dataclass(frozen=True, slots=True)
class Axes:
    """A rectangle of the drawing, and the ranges of its sides."""

    left: float
    top: float
    width: float
    height: float
    x: Point  #: from, to
    y: Point

    def at(self, x: float, y: float) -> Point:
        across = (x - self.x[0]) / (self.x[1] - self.x[0])
        up = (y - self.y[0]) / (self.y[1] - self.y[0])
        return self.left + across * self.width, self.top + (1.0 - up) * self.height


def plot(log: FlightLog) -> str:
    """Return the whole drawing."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        'font-family="system-ui, -apple-system, Segoe UI, Helvetica, Arial, sans-serif" font-size="13">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="8" fill="#ffffff"/>',
        *_range_plot(log),
        *_map(log),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _range_plot(log: FlightLog) -> list[str]:
    ranges = log.ranges()
    longest_s = math.ceil(ranges[-1][0] / 5) * 5.0
    furthest_m = math.ceil(max(distance for _, distance in ranges) + 0.2)
    axes = Axes(56, 52, 470, 268, (0.0, longest_s), (0.0, float(furthest_m)))
    found_s = (log.found_ns - log.places[0][0]) / 1e9
    parts = [_text(axes.left, 28, "True distance to the marker [m]", INK, weight=600)]
    for metres in range(furthest_m + 1):
        parts.append(_line([axes.at(0, metres), axes.at(longest_s, metres)], GRID, 1))
        parts.append(_text(axes.left - 10, axes.at(0, metres)[1] + 4, str(metres), FAINT, anchor="end"))
    for seconds in range(0, int(longest_s) + 1, 10):
        parts.append(_text(axes.at(seconds, 0)[0], axes.top + axes.height + 20, f"{seconds}", FAINT, anchor="middle"))
    parts.append(_text(axes.left + axes.width / 2, axes.top + axes.height + 42, "time [s]", FAINT, anchor="middle"))
    x, y = axes.at(0, 0)
    found_x = axes.at(found_s, 0)[0]
    parts.append(
        f'<rect x="{x:.1f}" y="{axes.top}" width="{found_x - x:.1f}" height="{axes.height}" fill="{FAINT}" '
        'fill-opacity="0.10"/>'
    )
    parts.append(_text((x + found_x) / 2, y - 12, "searching", FAINT, anchor="middle"))
    parts.append(_line([axes.at(0, log.wanted_m), axes.at(longest_s, log.wanted_m)], WANTED, 1.5, dash="6 5"))
    label = axes.at(longest_s, 1.0)
    parts.append(_text(label[0], label[1] - 6, f"wanted: {log.wanted_m:g} m", WANTED, anchor="end"))
    parts.append(_line([axes.at(*point) for point in ranges], DRONE, 2))
    return parts


def _map(log: FlightLog) -> list[str]:
    scale = 46.0  # drawing units a metre
    width, height = ROOM_M[0] * scale, ROOM_M[1] * scale
    axes = Axes(WIDTH - width - 24, 52, width, height, (-ROOM_M[0] / 2, ROOM_M[0] / 2), (-ROOM_M[1] / 2, ROOM_M[1] / 2))
    own = [axes.at(place[0], place[1]) for _, place, _ in log.places]
    board = [axes.at(place[0], place[1]) for _, _, place in log.places]
    size = f"{ROOM_M[0]:g} m × {ROOM_M[1]:g} m"
    foot = axes.top + axes.height + 24
    return [
        _text(axes.left, 28, f"From above, room of {size}", INK, weight=600),
        f'<rect x="{axes.left:.1f}" y="{axes.top}" width="{width:.1f}" height="{height:.1f}" fill="#f6f8fa" '
        f'stroke="{FAINT}" stroke-width="1.5"/>',
        _line(board, BOARD, 1.8),
        _line(own, DRONE, 1.8),
        *_ends(own, DRONE),
        *_ends(board, BOARD),
        *_legend(axes.left, foot, [("drone", DRONE), ("marker, carried about", BOARD)]),
        _text(axes.left + axes.width, foot, "○ start   ● end", FAINT, anchor="end"),
    ]


def _ends(line: list[Point], colour: str) -> list[str]:
    (x0, y0), (x1, y1) = line[0], line[-1]
    return [
        f'<circle cx="{x0:.1f}" cy="{y0:.1f}" r="5" fill="#ffffff" stroke="{colour}" stroke-width="2"/>',
        f'<circle cx="{x1:.1f}" cy="{y1:.1f}" r="5" fill="{colour}"/>',
    ]


def _legend(x: float, y: float, entries: Iterable[tuple[str, str]]) -> list[str]:
    parts = []
    for name, colour in entries:
        parts += [_line([(x, y - 4), (x + 18, y - 4)], colour, 3), _text(x + 24, y, name, INK)]
        x += 44 + 7.0 * len(name)
    return parts


def _line(points: list[Point], colour: str, width: float, *, dash: str = "") -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width:g}" '
        f'stroke-linejoin="round" stroke-linecap="round"{dashes}/>'
    )


def _text(x: float, y: float, text: str, colour: str, *, anchor: str = "start", weight: int = 400) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="{anchor}" font-weight="{weight}">{text}</text>'
