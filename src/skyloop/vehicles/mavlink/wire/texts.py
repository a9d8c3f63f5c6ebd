"""``STATUSTEXT``: long ones come in chunks of 50 characters with a number. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.vehicles.mavlink.wire.codec import Message, dialect

CHUNK: Final = 50
_MOST_OPEN: Final = 8  #: texts that are begun and not ended: the oldest is given out as it is


def chunks_of(text: str, severity: int, number: int) -> list[Message]:
    """The messages of one text. ``number``: of this text; 0 for one that fits one message."""
    data = text.encode("ascii", "replace")
    if len(data) < CHUNK:
        return [dialect.MAVLink_statustext_message(severity, data, 0, 0)]
    pieces = [data[at : at + CHUNK] for at in range(0, len(data) + 1, CHUNK)]  # the last one has room for its end
    return [dialect.MAVLink_statustext_message(severity, piece, number, at) for at, piece in enumerate(pieces)]


class Texts:
    """Puts chunks together. What a lost chunk held is shown as an ellipsis."""

    def __init__(self) -> None:
        self._open: dict[tuple[int, int], tuple[int, dict[int, str]]] = {}
        self._ended: dict[tuple[int, int], dict[int, str]] = {}

    def on_message(self, message: Message) -> list[tuple[int, str]]:
        """The texts that are complete with this message, with their severities (0 emergency to 7 debug).

        A chunk that comes twice, or after the last one of its text, makes no other text.
        """
        text = _printable(message.text)
        number = message.id
        if not number:
            return [(message.severity, text.strip())] if text.strip() else []
        key = message.get_srcComponent(), number
        if key in self._ended:
            if self._ended[key].get(message.chunk_seq, text) == text:
                return []
            del self._ended[key]  # the vehicle was started anew, and counts its texts from the beginning
        _, chunks = self._open.setdefault(key, (message.severity, {}))
        ended: list[tuple[int, str]] = []
        chunks[message.chunk_seq] = text
        if len(message.text) < CHUNK:
            ended.append(self._end(key))
        while len(self._open) > _MOST_OPEN:
            ended.append(self._end(next(iter(self._open))))
        return [(severity, whole) for severity, whole in ended if whole]

    def _end(self, key: tuple[int, int]) -> tuple[int, str]:
        severity, chunks = self._open.pop(key)
        self._ended[key] = chunks
        while len(self._ended) > _MOST_OPEN:
            del self._ended[next(iter(self._ended))]
        pieces = [chunks.get(at, "…") for at in range(max(chunks) + 1)]
        return severity, "".join(pieces).strip()


def _printable(text: str) -> str:
    return "".join(each if each.isprintable() or each == " " else " " for each in text)
