"""Label a thing in a recorded film with boxes, in every tenth frame.

If OpenCV supports windows: draw the box with the mouse, Space or Enter accepts it, C skips the frame.

    python -m scripts.label_film FILM LABELS.json --name "upper label"

Otherwise, from the command line, after viewing enlarged pictures of the frames:

    python -m scripts.label_film FILM LABELS.json --pictures FOLDER --zoom 3 --crop 0,0,120,260
    python -m scripts.label_film FILM LABELS.json --name "upper label" --box 0:5,1,32,56 --box 10:5,1,32,56
    python -m scripts.label_film FILM LABELS.json --name "upper label" --all 5,1,32,56      # if it does not move

The pictures show the boxes already in the file. A box is x, y, width and height in pixels.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.tracking_film import Labels, read_film, read_labels
from skyloop.errors import SkyloopError, UsageError
from skyloop.files import write
from skyloop.vision.tracking import Box, checked_box


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("film", type=Path, help="a PaVE stream of an AR.Drone 2")
    parser.add_argument("labels", type=Path, help="the JSON file, created if missing")
    parser.add_argument("--name", help="name of the thing")
    parser.add_argument("--each", type=int, default=10, help="step in frames [default: 10]")
    parser.add_argument("--box", action="append", default=[], metavar="FRAME:X,Y,WIDTH,HEIGHT")
    parser.add_argument("--all", metavar="X,Y,WIDTH,HEIGHT", help="the same box in each of the frames")
    parser.add_argument("--how", help="how the boxes were made, kept in the file")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="write the frames with their boxes, as PNG")
    parser.add_argument("--crop", metavar="X,Y,WIDTH,HEIGHT", help="part of the pictures to show")
    parser.add_argument("--zoom", type=int, default=2, help="enlargement of the pictures and the window [default: 2]")
    options = parser.parse_args()
    try:
        film = read_film(options.film)
        label(film, options)
    except SkyloopError as error:
        parser.error(str(error))


def label(film: NDArray[np.uint8], options: argparse.Namespace) -> None:
    wanted = range(0, len(film), options.each)
    rows, columns = film.shape[1:3]
    known = (
        read_labels(options.labels)
        if options.labels.exists()
        else Labels(f"{options.film.parent.name}/{options.film.name}", (columns, rows), "", {})
    )
    objects = {name: dict(boxes) for name, boxes in known.objects.items()}
    if options.name:
        boxes = objects.setdefault(options.name, {})
        if options.all:
            boxes.update(dict.fromkeys(wanted, numbers(options.all)))
        for text in options.box:
            frame, _, box = text.partition(":")
            if not frame.isdecimal() or int(frame) >= len(film):
                raise UsageError(f"--box must begin with a frame's number up to {len(film) - 1}, got {text!r}")
            boxes[int(frame)] = numbers(box)
        if not options.all and not options.box:
            boxes.update(drawn(film, wanted, options.name, options.zoom))
        for box in boxes.values():
            checked_box(box, film.shape[1:])
        write(
            options.labels,
            msgspec.json.format(msgspec.json.encode(Labels(known.film, known.size, options.how or known.how, objects)))
            + b"\n",
        )
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
        x, y, width, height = map(round, numbers(options.crop)) if options.crop else (0, 0, columns, rows)
        for n in wanted:
            picture = enlarged(film[n], [boxes[n] for boxes in objects.values() if n in boxes], options.zoom)
            part = picture[
                y * options.zoom : (y + height) * options.zoom, x * options.zoom : (x + width) * options.zoom
            ]
            cv2.imwrite(str(options.pictures / f"{n:04}.png"), part)


def drawn(film: NDArray[np.uint8], wanted: range, name: str, zoom: int) -> dict[int, Box]:
    """Return the boxes drawn by the user in a window."""
    found: dict[int, Box] = {}
    for n in wanted:
        try:
            box = cv2.selectROI(f"{name}, frame {n}", enlarged(film[n], [], zoom))
            cv2.destroyAllWindows()
        except cv2.error:
            raise UsageError("this OpenCV has no windows: give the boxes with --box or --all") from None
        if box[2] and box[3]:
            found[n] = (box[0] / zoom, box[1] / zoom, box[2] / zoom, box[3] / zoom)
    return found


def enlarged(frame: NDArray[np.uint8], boxes: list[Box], zoom: int) -> NDArray[np.uint8]:
    large = cv2.resize(frame, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    for x, y, width, height in boxes:
        far = (round((x + width) * zoom) - 1, round((y + height) * zoom) - 1)
        cv2.rectangle(large, (round(x * zoom), round(y * zoom)), far, (0, 0, 255), 1)
    return np.asarray(large, np.uint8)


def numbers(text: str) -> Box:
    parts = text.split(",")
    try:
        x, y, width, height = (float(part) for part in parts)
    except ValueError:
        raise UsageError(f"{text!r} must be x, y, width and height in pixels, such as 5,1,32,56") from None
    return x, y, width, height


if __name__ == "__main__":
    main()
