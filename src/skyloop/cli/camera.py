"""``skyloop camera``: prints calibration boards, calibrates cameras with them, and lists this machine's cameras."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Self

import typer

from skyloop.cli.naming import DroneOption, KeysOption, NetworkOption, join_network, one_drone
from skyloop.cli.text import tell
from skyloop.errors import NoAnswerError, UnknownNameError, UsageError
from skyloop.files import read_bytes
from skyloop.messages.frame import image_size, why_not_decoded

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from skyloop.calibration import Calibration
    from skyloop.vision.calibrating import Board, BoardFinder, BoardView, Collector

    Picture = tuple[str, NDArray[np.uint8]]  # name and image

camera = typer.Typer(no_args_is_help=True, rich_markup_mode=None)

_EXAMPLE: Final = "Example: skyloop camera "
_MAX_BYTES: Final = 256 << 20  #: maximum size of an image file
_PICTURES: Final = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
_GOOD_COVERAGE: Final = 0.5  # warn if a smaller fraction of the image was covered by views of the board
_GOOD_RMS_PX: Final = 1.0  # warn if the reprojection error is larger
_PATIENCE_S: Final = 10.0  # maximum time spent waiting for a frame


class Kind(StrEnum):
    CHARUCO = "charuco"
    CHESSBOARD = "chessboard"


class Lens(StrEnum):
    PINHOLE = "pinhole"
    FISHEYE = "fisheye"


Columns = Annotated[int, typer.Option(metavar="N", help="Squares across")]
Rows = Annotated[int, typer.Option(metavar="N", help="Squares down")]
SquareMm = Annotated[float, typer.Option(metavar="MM", help="Side of a square; measure it after printing")]
KindOption = Annotated[Kind, typer.Option(help="A ChArUco board may be partly visible, a chessboard must be whole")]
Dictionary = Annotated[str, typer.Option(metavar="NAME", help="The markers of a ChArUco board")]


@camera.callback()
def _camera() -> None:
    """Print a calibration board, calibrate a camera with images of it, and list this machine's cameras.

    skyloop camera COMMAND --help describes each command.
    """


@camera.command(short_help="Write a board to print", epilog=f"{_EXAMPLE}board -o board.pdf")
def board(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="A .pdf or .png")] = Path("board.pdf"),
    columns: Columns = 7,
    rows: Rows = 5,
    square_mm: SquareMm = 33.0,
    kind: KindOption = Kind.CHARUCO,
    dictionary: Dictionary = "4x4_50",
    dpi: Annotated[int, typer.Option(min=30, max=1200, help="Resolution of a .png")] = 300,
) -> None:
    """Write a calibration board; the default fits A4. Print the board at 100 %, and glue it onto something flat."""
    made = _board(columns, rows, square_mm, kind, dictionary)
    made.save(output, dpi)
    size = f"{(columns + 1) * square_mm:g} × {(rows + 1) * square_mm:g} mm"
    typer.echo(f"wrote {output}: {columns} × {rows} squares of {square_mm:g} mm, {size} with its margin")


@camera.command(short_help="Calibrate with images of a board", epilog=f"{_EXAMPLE}calibrate alpha -o front.json")
def calibrate(
    source: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME|FILE...", help="A running proxy's NAME or a vehicle's address; or files: images, a video"
        ),
    ] = None,
    drone: DroneOption = None,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="File to write")] = Path("camera.json"),
    camera: Annotated[
        str | None, typer.Option(metavar="NAME", help="The vehicle's camera [default: the first]")
    ] = None,
    model: Annotated[Lens, typer.Option(help="Lens model; a fisheye sees more than about 100° across")] = Lens.PINHOLE,
    views: Annotated[int, typer.Option(min=6, max=200, help="Number of views to take from a vehicle or a video")] = 25,
    seconds: Annotated[float, typer.Option(metavar="S", min=1.0, help="Maximum time to search for them")] = 180.0,
    columns: Columns = 7,
    rows: Rows = 5,
    square_mm: SquareMm = 33.0,
    kind: KindOption = Kind.CHARUCO,
    dictionary: Dictionary = "4x4_50",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing file")] = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Find a camera's focal length, principal point and distortion, and write them to a JSON file.

    Show the board close up and from a distance, in all corners of the image, and tilted. Views that differ enough are
    taken automatically; press Ctrl-C to stop early.
    """
    from skyloop.vision.calibrating import BoardFinder
    from skyloop.vision.calibrating import calibrate as fit

    join_network(network, keys)
    named = source or [one_drone(None, drone)]
    if output.exists() and not overwrite:
        raise UsageError(f"{output} exists: choose another name, or give --overwrite")
    search = _Search(BoardFinder(_board(columns, rows, square_mm, kind, dictionary)), views)
    if _are_files(named):
        search.every = all(_is_picture(name) for name in named)
        search.run(_from_files(named))
    else:
        with _Vehicle(named[0], camera, seconds) as vehicle:
            tell(
                f"looking for a board of {columns} × {rows} squares for at most {seconds:g} s; Ctrl-C ends that earlier"
            )
            search.run(vehicle.pictures(), vehicle.draw)
    collector = search.collector
    if collector is None:
        raise UsageError("no frame arrived")
    tell(f"{search.looked} images searched, {len(collector.views)} views of the board taken")
    found, rejected = fit(collector.views, *collector.size, model=model.value, camera=camera or "")
    found.save(output)
    _report(found, rejected, output)


@camera.command("list", short_help="List the cameras of this machine", epilog=f"{_EXAMPLE}list")
def list_cameras() -> None:
    """List this machine's cameras: addresses, formats, sizes, rates, exposure and gain."""
    from skyloop.vehicles.video.v4l2 import cameras, described, listed

    found = cameras()
    if not found:
        typer.echo(described(found))
    for device in found:
        typer.echo("\n".join(listed(device)))


class _Search:
    """Searches images for the board, one after another."""

    def __init__(self, finder: BoardFinder, most: int) -> None:
        self.every = False  #: whether to use every view (single images) or only views that differ (a stream)
        self.collector: Collector | None = None
        self.looked = 0
        self._finder = finder
        self._most = most

    def run(self, pictures: Iterable[Picture], found: Callable[[Any, BoardView], None] | None = None) -> None:
        """Search until the images end, enough views are found, or Ctrl-C. Raise ``UsageError`` if the sizes differ."""
        from skyloop.vision.calibrating import Collector

        try:
            for name, picture in pictures:
                self.looked += 1
                size = (picture.shape[1], picture.shape[0])
                if self.collector is None:
                    self.collector = Collector(*size)
                elif self.collector.size != size:
                    raise UsageError(f"{name} has {_by(size)} pixels, earlier ones have {_by(self.collector.size)}")
                view = self._finder.find(picture, name)
                if view is not None and found is not None:
                    found(picture, view)
                self._take(self.collector, view, name)
                if not self.every and len(self.collector.views) >= self._most:
                    break
        except KeyboardInterrupt:
            tell("ended by Ctrl-C")

    def _take(self, collector: Collector, view: BoardView | None, name: str) -> None:
        if view is None:
            if self.every:
                tell(f"{name}: the board is not visible, or too little of it")
        elif self.every:
            collector.views.append(view)
        elif collector.offer(view):
            seen = f"{len(view.pixels)} corners, {collector.coverage:.0%} of the image covered"
            tell(f"view {len(collector.views)}: {seen}")


def _board(columns: int, rows: int, square_mm: float, kind: Kind, dictionary: str) -> Board:
    from skyloop.vision.calibrating import Board

    return Board(columns, rows, square_mm / 1000, kind.value, dictionary)


def _report(found: Calibration, rejected: list[BoardView], output: Path) -> None:
    for view in rejected:
        tell(f"left out, because it does not fit the others: {view.name}")
    sure = "" if found.fx_deviation is None else f" ± {found.fx_deviation:.1f}"
    assert found.rms_px is not None
    assert found.coverage is not None
    typer.echo(f"{found.model}, {found.width}x{found.height}: fx {found.fx:.1f}{sure}, fy {found.fy:.1f} px, ")
    typer.echo(
        f"centre {found.cx:.1f}, {found.cy:.1f} px, distortion {', '.join(f'{k:.4f}' for k in found.distortion)}"
    )
    typer.echo(f"reprojection error {found.rms_px:.3f} px RMS over {found.views} views, coverage {found.coverage:.0%}")
    if found.rms_px > _GOOD_RMS_PX:
        tell("that error is large: is the board flat, and its number of squares correct?")
    if found.coverage < _GOOD_COVERAGE:
        tell("little of the image was covered: the distortion is only known there; also show the board in the corners")
    typer.echo(f"wrote {output}")


def _are_files(source: list[str]) -> bool:
    """Return whether the sources are files. Raise ``UsageError`` if only some of them are files."""
    files = [Path(name).is_file() for name in source]
    if any(files) and not all(files):
        raise UsageError(f"no file {source[files.index(False)]!r}: give only files, or one vehicle")
    if not any(files) and len(source) > 1:
        raise UsageError(f"no file {source[0]!r}: give files, or one vehicle")
    return all(files)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _is_picture(name: str) -> bool:
    return Path(name).suffix.lower() in _PICTURES


def _from_files(names: list[str]) -> Iterator[Picture]:
    from skyloop.vision.opencv import opencv

    cv = opencv("reading pictures")
    for name in names:
        if _is_picture(name):
            yield name, _from_picture(cv, name)
        else:
            yield from _from_video(cv, name)


def _from_picture(cv: Any, name: str) -> Any:
    import numpy as np

    content = read_bytes(name, "the picture", _MAX_BYTES)
    picture = None
    if image_size(content) is None or not why_not_decoded(content):  # OpenCV itself limits images in other formats
        picture = cv.imdecode(np.frombuffer(content, np.uint8), cv.IMREAD_COLOR) if content else None
    if picture is None:
        raise UsageError(f"{name} can't be read as an image")
    return picture


def _from_video(cv: Any, name: str) -> Iterator[Picture]:
    video, number = cv.VideoCapture(name), 0
    try:
        while True:
            read, picture = video.read()
            if not read:
                break
            number += 1
            yield f"{name}, frame {number}", picture
    finally:
        video.release()
    if not number:
        raise UsageError(f"{name} can't be read as a video")


class _Vehicle:
    """Context manager that uses a vehicle's camera for a limited time."""

    def __init__(self, source: str, camera: str | None, seconds: float) -> None:
        from skyloop.client import connect

        try:
            self._drone = connect(source, access="observe", name="skyloop camera")
        except UnknownNameError as error:
            raise UsageError(f"{source} is neither a file nor a running proxy: {error}") from error
        self._camera = camera
        self._seconds = seconds

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._drone.close()

    def pictures(self) -> Iterator[Picture]:
        """Yield the newest frames until the time is up or no more frames arrive."""
        end = time.monotonic() + self._seconds
        try:
            for frame in self._drone.frames(self._camera, timeout_s=_PATIENCE_S):
                yield f"frame {frame.seq}", frame
                if time.monotonic() > end:
                    tell(f"{self._seconds:g} s are over")
                    return
        except NoAnswerError as error:
            tell(str(error))

    def draw(self, frame: Any, view: BoardView) -> None:
        """Draw the detected board on the video shown in the cockpit."""
        from skyloop.messages import Points

        corners = tuple((float(x), float(y)) for x, y in view.pixels)
        self._drone.annotate(frame, [Points(corners, (64, 220, 100))], source="calibration")
