"""Write UVLC by hand, bit by bit, from the format's description and independent of Skyloop's encoder."""

from __future__ import annotations

START = "0000000000000000" + "100000"
P264 = "000000000000000" + "1000000"
END = "0000000000000000" + "111111"
END_OF_BLOCK = "1" + "01"
GREY = 341  # the mean of a block, in steps of 3 eighths: 127.9


def run(zeros: int) -> str:
    if zeros == 0:
        return "1"
    digits = f"{zeros:b}"
    return "0" * len(digits) + "1" + digits[1:]


def level(value: int) -> str:
    sign = "1" if value < 0 else "0"
    if abs(value) == 1:
        return "1" + sign
    digits = f"{abs(value):b}"
    return "0" * len(digits) + "1" + digits[1:] + sign


def header(
    *, form: int = 1, resolution: int = 1, kind: int = 0, quant: int = 31, number: int = 5, start: str = START
) -> str:
    return f"{start}{form:02b}{resolution:03b}{kind:03b}{quant:05b}{number:032b}"


def group(number: int, quant: int = 31) -> str:
    return f"0000000000000000{32 + number:06b}{quant:05b}"


def macroblock(means: list[int], pairs: dict[int, str] | None = None, dquant: str = "") -> str:
    """Return a coded macroblock: the 6 means, and the codes of the blocks with pairs, without their end."""
    pairs = pairs or {}
    described = 0x80 | (0x40 if dquant else 0) | sum(1 << block for block in pairs)
    bits = f"0{described:08b}{dquant}"
    for block, mean in enumerate(means):
        bits += f"{mean:010b}"
        if block in pairs:
            bits += pairs[block] + END_OF_BLOCK
    return bits


def grey(quant: int) -> str:
    """Return a macroblock as close to grey as the quantiser allows."""
    return macroblock([round(1024 / (1 + quant)) if quant < 31 else GREY] * 6)


PLAIN = grey(31)
NOT_CODED = "1"


def aligned(bits: str, size: int = 8) -> str:
    return bits + "0" * (-len(bits) % size)


def picture(
    groups: list[list[str]] | None = None,
    *,
    start: str | None = None,
    quants: tuple[int, ...] = (31, 31, 31, 31),
    size: int = 8,
) -> str:
    """Return the bits of a picture of 88x72, which has 4 coded groups of 5 macroblocks; plain grey by default."""
    groups = groups or [[PLAIN] * 5] * 4
    bits = start or header(quant=quants[0])
    for number, macroblocks in enumerate(groups):
        if number:
            bits = aligned(bits, size) + group(number, quants[number])
        bits += "".join(macroblocks)
    return aligned(bits, size) + END


def with_first(first: str) -> str:
    """Return the bits of a picture that is plain except for its first macroblock."""
    return picture([[first, *[PLAIN] * 4], *[[PLAIN] * 5] * 3])


def packet(bits: str) -> bytes:
    """Return the datagram: 32-bit words, little-endian."""
    bits = aligned(bits, 32)
    return b"".join(int(bits[at : at + 32], 2).to_bytes(4, "little") for at in range(0, len(bits), 32))
