"""The planar renderer's loops over quads and pixels, written so that Numba can compile them (``compiled``).

The loops compute the same as ``shading``, operation by operation in the same order and precision, so the image is
bit-identical; that module explains the mathematics. They also run uncompiled, though slowly, for tests without Numba.
Each kernel is one flat function, because a compiled function can't call an uncompiled one. Compiled loops don't hold
the interpreter lock.

Inner loops are short, write one array each and stay in single precision; otherwise they would not be vectorised.
Constants from other modules are arguments, because Numba's cache checks only this file for changes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from skyloop.sim.render.quads import Floats

    Singles = NDArray[np.float32]
    Shorts = NDArray[np.int16]

BLOCK = 512  # pixels per batch: small enough for the working arrays to stay in the cache
BAND = 16  # grid rows per batch; small for the same reason
FEW = 8  # number of grid rows compared at a time
NUMBER = 0x7FFF  # bit mask of a sample's number; the sign bit marks a different sample nearby
_ROUND = np.float32(3 << 22)  # adding and subtracting this rounds a number up to 2^22 to an integer; halves go to even


def prepare(
    vectors: Floats,  # see ``Quads``, which also describes the next three arguments
    starts: Floats,  # see ``Quads``
    two_sided: NDArray[np.bool_],  # see ``Quads``
    lit: NDArray[np.bool_],  # see ``Quads``
    shown: NDArray[np.bool_],  # whether each quad is drawn at all, (n,)
    weight: Floats,  # factor applied to each quad's inverse depth, from its priority, (n,)
    density: Floats,  # see ``Quads``
    origin: Floats,  # x, y and span in the atlas of each quad's texture, (n, 3)
    position: Floats,  # position of the camera
    rotation: Floats,  # rotation from optical to world axes
    # edge-on limit [m], ambient light, direct light, unit of light, factor of the footprint, direction to the light,
    # unit
    constants: Floats,
    grid: Floats,  # width, height, fx, fy, cx, cy
    pixel_area: float,  # 1/(fx fy) of the image
    # output: edge planes of each selected quad, as slopes along the grid's x and y and an offset, (n, 4, 3)
    edges: Floats,
    planes: Floats,  # output: each selected quad's 1/z on the grid, as slopes along x and y plus an offset, (n, 3)
    # output: the first grid row the quad may cover, the row after the last, and the same for columns, (n, 4)
    box: NDArray[np.int64],
    table: Singles,  # output: see ``sampling_table``, (13, n + 1)
) -> int:
    """Select the quads that may be visible, as ``visible_quads`` and ``sampling_table`` do.

    Returns:
        The number of quads selected.
    """
    width, height, fx, fy, cx, cy = grid[0], grid[1], grid[2], grid[3], grid[4], grid[5]
    left, right = -(0.5 + cx) / fx, (width - 0.5 - cx) / fx
    top, bottom = -(0.5 + cy) / fy, (height - 0.5 - cy) / fy
    edge_on, ambient, direct, unit, footprint = constants[0], constants[1], constants[2], constants[3], constants[4]
    p0, p1, p2 = position[0], position[1], position[2]
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    table[:, 0] = 0.0
    table[8, 0] = 1.0
    x, y, z = np.empty(4), np.empty(4), np.empty(4)
    count = 0
    for k in range(len(shown)):
        if not shown[k]:
            continue
        n0, n1, n2 = vectors[k, 4, 0], vectors[k, 4, 1], vectors[k, 4, 2]
        above = n0 * (p0 - vectors[k, 0, 0]) + n1 * (p1 - vectors[k, 0, 1]) + n2 * (p2 - vectors[k, 0, 2])
        if not (above > edge_on or (two_sided[k] and above < -edge_on)):
            continue
        off_left = off_right = off_top = off_bottom = behind = True
        ahead = True
        for i in range(4):
            d0, d1, d2 = vectors[k, i, 0] - p0, vectors[k, i, 1] - p1, vectors[k, i, 2] - p2
            x[i] = d0 * r00 + d1 * r10 + d2 * r20
            y[i] = d0 * r01 + d1 * r11 + d2 * r21
            z[i] = d0 * r02 + d1 * r12 + d2 * r22
            off_left &= x[i] < left * z[i]
            off_right &= x[i] > right * z[i]
            off_top &= y[i] < top * z[i]
            off_bottom &= y[i] > bottom * z[i]
            behind &= z[i] <= 0.0
            ahead &= z[i] > 1e-3
        if off_left or off_right or off_top or off_bottom or behind:
            continue
        first_row, last_row, first_column, last_column = 0.0, height, 0.0, width
        if ahead:  # add a margin of two samples for rounding, because the edge planes make the final decision
            first_row, last_row, first_column, last_column = height, -1.0, width, -1.0
            for i in range(4):
                row, column = y[i] / z[i] * fy + cy, x[i] / z[i] * fx + cx
                first_row, last_row = min(first_row, row - 2.0), max(last_row, row + 3.0)
                first_column, last_column = min(first_column, column - 2.0), max(last_column, column + 3.0)
        box[count, 0] = int(min(max(first_row, 0.0), height))
        box[count, 1] = int(min(max(last_row, 0.0), height))
        box[count, 2] = int(min(max(first_column, 0.0), width))
        box[count, 3] = int(min(max(last_column, 0.0), width))
        sign = -1.0 if above > 0.0 else 1.0
        for i in range(4):
            j = (i + 1) % 4
            across = (y[i] * z[j] - z[i] * y[j]) * sign / fx
            down = (z[i] * x[j] - x[i] * z[j]) * sign / fy
            edges[count, i, 2] = (x[i] * y[j] - y[i] * x[j]) * sign - across * cx - down * cy
            edges[count, i, 0], edges[count, i, 1] = across if across != 0.0 else 1e-30, down
        c0 = (n0 * r00 + n1 * r10 + n2 * r20) / -above
        c1 = (n0 * r01 + n1 * r11 + n2 * r21) / -above
        c2 = (n0 * r02 + n1 * r12 + n2 * r22) / -above
        along_x, along_y, start = c0 * weight[k] / fx, c1 * weight[k] / fy, c2 * weight[k]
        planes[count, 0], planes[count, 1] = along_x, along_y
        planes[count, 2] = start - along_x * cx - along_y * cy
        count += 1
        u0, u1, u2 = vectors[k, 5, 0], vectors[k, 5, 1], vectors[k, 5, 2]
        v0, v1, v2 = vectors[k, 6, 0], vectors[k, 6, 1], vectors[k, 6, 2]
        under_u = u0 * p0 + u1 * p1 + u2 * p2 + starts[k, 0] - origin[k, 2]
        under_v = v0 * p0 + v1 * p1 + v2 * p2 + starts[k, 1]
        table[0, count] = u0 * r00 + u1 * r10 + u2 * r20 + under_u * c0
        table[1, count] = u0 * r01 + u1 * r11 + u2 * r21 + under_u * c1
        table[2, count] = u0 * r02 + u1 * r12 + u2 * r22 + under_u * c2
        table[3, count] = v0 * r00 + v1 * r10 + v2 * r20 + under_v * c0
        table[4, count] = v0 * r01 + v1 * r11 + v2 * r21 + under_v * c1
        table[5, count] = v0 * r02 + v1 * r12 + v2 * r22 + under_v * c2
        table[6, count], table[7, count], table[8, count] = c0, c1, c2
        table[9, count] = density[k] / abs(above) * (pixel_area * footprint)
        table[10, count] = origin[k, 0] + origin[k, 2] - 0.5
        table[11, count] = origin[k, 1] - 0.5
        light = 1.0
        if lit[k]:
            light = ambient + direct * max((n0 * constants[5] + n1 * constants[6] + n2 * constants[7]) * -sign, 0.0)
        table[12, count] = light * unit
    return count


def draw(
    count: int,  # the result of :func:`prepare`, which also wrote the next four arguments
    edges: Floats,  # see :func:`prepare`
    planes: Floats,  # see :func:`prepare`
    box: NDArray[np.int64],  # see :func:`prepare`
    table: Singles,  # see :func:`prepare`
    samples: int,  # samples per pixel, 1 or 4
    to_grid: Singles,  # see ``Raster``
    rows_for: NDArray[np.int64],  # number of grid rows needed for each row of the image, (height,)
    ray_x: Singles,  # x of each pixel's ray (x, y, 1), (height, width)
    ray_y: Singles,  # y of each pixel's ray, (height, width)
    sample_x: Singles,  # x of the rays through each column of the grid
    sample_y: Singles,  # y of the ray through each row of the grid
    nearest: Singles,  # work array: 1/z at each sample of a band, (BAND, columns)
    numbers: NDArray[np.int32],  # work array, (BAND, columns)
    # Work array: each sample's column in the table, or 0 for none. The sign bit is set if the sample may differ from
    # its neighbours to the right and below. Holds the most recently processed grid rows: as many as the image needs at
    # a time, rounded up to a power of two. (rows, columns).
    seen: Shorts,
    pairs: NDArray[np.int64],  # each texel of the atlas and the texel after it, BGRA each, packed into one number
    atlas_size: tuple[int, int],  # number of rows and columns of the atlas
    gap: float,  # gap between two levels of a texture in the atlas [texels]
    farthest: float,  # 1/z assumed for a ray that points beyond a quad's horizon [1/m]
    # box of each shadow: first row, row after the last, first column, column after the last, (s, 4)
    boxes: NDArray[np.int64],
    axes: Singles,  # rotation from optical to world axes
    # ``Placed.numbers``: below, away x, away y, squared radius, strength, thickness, its constant part, (s, 7)
    shadows: Singles,
    picture: NDArray[np.uint8],  # output: BGR, (height, width, 3)
    # the image's memory, read as one number per pixel except the last, at intervals of three bytes
    packed: NDArray[np.int32],
) -> None:
    """Draw the same image as ``PlainPainter`` with ``DepthBuffer``, ``Shader`` and ``darken``.

    For each band of the grid, find the nearest quad at each sample. Then colour the image rows that depend on no
    further bands, while this band is still in the cache.
    """
    zero, half, one, full = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(255.0)
    three, parts = np.float32(3.0), np.float32(32.0)  # a texel is divided into 32 parts along each side
    most_u, most_v = np.float32(atlas_size[1] - 2), np.float32(atlas_size[0] - 2)
    between, far = np.float32(gap), np.float32(farthest)
    stride = np.int32(atlas_size[1])
    next_row = np.uint64(atlas_size[1])  # unsigned, so that Numba skips the check for negative indices
    scale_x, scale_y, start_x, start_y = to_grid[0], to_grid[1], to_grid[2], to_grid[3]
    height, width = ray_x.shape
    grid_rows, columns = len(sample_y), len(sample_x)
    kept = len(seen) - 1  # bit mask that maps a grid row to its row in ``seen``
    kept_, columns_ = np.int32(kept), np.int32(columns)
    seen_ = seen.reshape(-1)
    wide = float(columns)
    along = np.empty((count, columns), np.float32)
    crossings = np.empty((count, 4, 2))
    for k in range(count):
        for column in range(box[k, 2], box[k, 3]):
            along[k, column] = planes[k, 0] * column
        for i in range(4):
            crossings[k, i, 0] = edges[k, i, 1] / -edges[k, i, 0]
            crossings[k, i, 1] = edges[k, i, 2] / -edges[k, i, 0]
    differs, near_by = np.empty(columns, np.int16), np.empty(columns, np.int16)
    none, sign = np.int16(0), np.int16(~NUMBER)
    room = 5 * BLOCK  # one entry per pixel, and four more for its samples if they differ
    number, mixed = np.empty(room, np.int32), np.empty(BLOCK, np.int32)
    x_, y_, w_ = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
    u_, v_, size = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
    left, top_, light = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.int32)
    part_u, part_v, spot = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room, np.int32)
    upper, lower = np.empty(room, np.int64), np.empty(room, np.int64)
    above_, below_ = upper.view(np.int32), lower.view(np.int32)
    colours = np.empty(room, np.int32)
    depth, shade = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.int32)
    flat_x, flat_y = ray_x.reshape(-1), ray_y.reshape(-1)
    known = compared = 0  # numbers of grid rows
    for begin in range(0, height * width, BLOCK):
        count_ = min(BLOCK, height * width - begin)
        first_row, last_row = begin // width, (begin + count_ - 1) // width
        while known < rows_for[last_row]:
            top, bottom = known, min(known + BAND, grid_rows)
            nearest[:] = 0.0
            numbers[:] = 0
            for k in range(count):
                own = np.int32(k + 1)
                for row in range(max(top, box[k, 0]), min(bottom, box[k, 1])):
                    low, high = -1.0, wide
                    for i in range(4):
                        crossing = crossings[k, i, 0] * row + crossings[k, i, 1]
                        if edges[k, i, 0] > 0.0:
                            low = max(low, crossing)
                        else:
                            high = min(high, crossing)
                    first = int(np.ceil(min(max(low, 0.0), wide)))
                    end = int(np.floor(min(max(high, -1.0), wide - 1.0))) + 1
                    if first >= end:
                        continue
                    along_row = np.float32(planes[k, 1] * row + planes[k, 2])
                    near, shown, across = (
                        nearest[row - top, first:end],
                        numbers[row - top, first:end],
                        along[k, first:end],
                    )
                    for n in range(end - first):
                        candidate = across[n] + along_row
                        closer = candidate > near[n]
                        near[n] = candidate if closer else near[n]
                        shown[n] = own if closer else shown[n]
            for row in range(top, bottom):
                shown, line = numbers[row - top], seen[row & kept]
                for n in range(columns):
                    line[n] = shown[n]
            known = bottom
            # Process a few rows at a time: first set the bits for differences within a column, including the row below,
            # then those for differences from the next column.
            last = bottom if bottom == grid_rows or samples == 1 else bottom - 1
            while compared < last:
                end = min(compared + FEW, last)
                base = seen[compared & kept]
                differs[:] = 0
                for row in range(compared + 1, min(end + 1, grid_rows)):
                    line = seen[row & kept]
                    for n in range(columns):
                        differs[n] |= line[n] ^ base[n]
                for n in range(columns - 1):
                    near_by[n] = differs[n] | differs[n + 1] | base[n] ^ base[n + 1]
                near_by[columns - 1] = differs[columns - 1]
                for n in range(columns):
                    near_by[n] = sign if near_by[n] != 0 else none
                for row in range(compared, end):
                    line = seen[row & kept]
                    for n in range(columns):
                        line[n] |= near_by[n]
                compared = end
        # Find the quad at each pixel, and the pixels that contain several quads.
        xs, ys = flat_x[begin : begin + count_], flat_y[begin : begin + count_]
        for n in range(count_):
            at_x, at_y = np.int32(xs[n] * scale_x + start_x), np.int32(ys[n] * scale_y + start_y)
            spot[n] = np.int32(np.int32(np.int32(at_y & kept_) * columns_) + at_x)
        for n in range(count_):
            number[n] = seen_[np.uint64(spot[n])]
        total = count_
        mixtures = 0
        for n in range(count_):
            if number[n] < 0:
                number[n] &= NUMBER
                if samples == 1:
                    continue
                row, column = int(ys[n] * scale_y + start_y), int(xs[n] * scale_x + start_x)
                above, below = seen[row & kept], seen[row + 1 & kept]
                a, b = above[column] & NUMBER, above[column + 1] & NUMBER
                c, d = below[column] & NUMBER, below[column + 1] & NUMBER
                if a ^ b | a ^ c | a ^ d:
                    mixed[mixtures] = n
                    mixtures += 1
                    number[total], number[total + 1], number[total + 2], number[total + 3] = a, b, c, d
                    x_[total], x_[total + 1] = sample_x[column], sample_x[column + 1]
                    x_[total + 2], x_[total + 3] = sample_x[column], sample_x[column + 1]
                    y_[total], y_[total + 1] = sample_y[row], sample_y[row]
                    y_[total + 2], y_[total + 3] = sample_y[row + 1], sample_y[row + 1]
                    total += 4
        # Compute texture coordinate coefficients per run of pixels in a row with the same quad, then per sample.
        start = 0
        while start < count_:
            quad = number[start]
            end = start + 1
            while end < count_ and number[end] == quad:
                end += 1
            # Round up to a multiple in order to avoid a remainder; the next run overwrites the excess pixels.
            stop = min(start + (end - start + 31) // 32 * 32, count_)
            xs, ys = flat_x[begin + start : begin + stop], flat_y[begin + start : begin + stop]
            into = w_[start:stop]
            p, q, r = table[6, quad], table[7, quad], table[8, quad]
            for n in range(len(into)):
                into[n] = p * xs[n] + q * ys[n] + r
            into = u_[start:stop]
            p, q, r = table[0, quad], table[1, quad], table[2, quad]
            for n in range(len(into)):
                into[n] = p * xs[n] + q * ys[n] + r
            into = v_[start:stop]
            p, q, r = table[3, quad], table[4, quad], table[5, quad]
            for n in range(len(into)):
                into[n] = p * xs[n] + q * ys[n] + r
            size[start:stop] = table[9, quad]
            left[start:stop] = table[10, quad]
            top_[start:stop] = table[11, quad]
            light[start:stop] = np.int32(table[12, quad])
            start = end
        for n in range(count_, total):
            quad, x, y = number[n], x_[n], y_[n]
            w_[n] = table[6, quad] * x + table[7, quad] * y + table[8, quad]
            u_[n] = table[0, quad] * x + table[1, quad] * y + table[2, quad]
            v_[n] = table[3, quad] * x + table[4, quad] * y + table[5, quad]
            size[n], left[n], top_[n] = table[9, quad], table[10, quad], table[11, quad]
            light[n] = np.int32(table[12, quad])
        for n in range(total):
            w = w_[n] if w_[n] > far else far
            w_[n] = w
            inverse = one / w
            area = size[n] * inverse * inverse * inverse
            at, by = zero, one
            at = at if area < np.float32(4.0) else one
            by = by if area < np.float32(4.0) else half
            at = at if area < np.float32(16.0) else np.float32(2.0)
            by = by if area < np.float32(16.0) else np.float32(0.25)
            at = at if area < np.float32(64.0) else np.float32(3.0)
            by = by if area < np.float32(64.0) else np.float32(0.125)
            at = at if area < np.float32(256.0) else np.float32(4.0)
            by = by if area < np.float32(256.0) else np.float32(0.0625)
            at = at if area < np.float32(1024.0) else np.float32(5.0)
            by = by if area < np.float32(1024.0) else np.float32(0.03125)
            at = at if area < np.float32(4096.0) else np.float32(6.0)
            by = by if area < np.float32(4096.0) else np.float32(0.015625)
            scale = inverse * by
            u = u_[n] * scale + between * at + left[n]
            u = u if u > zero else zero
            u = u if u < most_u else most_u
            v = v_[n] * scale + top_[n]
            v = v if v > zero else zero
            v = v if v < most_v else most_v
            at_u, at_v = np.int32(u * parts + _ROUND - _ROUND), np.int32(v * parts + _ROUND - _ROUND)
            part_u[n], part_v[n] = np.int32(at_u & 31), np.int32(at_v & 31)
            spot[n] = np.int32(np.int32(np.int32(at_v >> 5) * stride) + np.int32(at_u >> 5))
        for n in range(total):
            texel = np.uint64(spot[n])
            upper[n], lower[n] = pairs[texel], pairs[texel + next_row]
        # Interpolate between four texels: blue and red are processed together, as long as both fit into sixteen bits.
        for n in range(total):
            a, b, c, d = above_[2 * n], above_[2 * n + 1], below_[2 * n], below_[2 * n + 1]
            right, down, bright = part_u[n], part_v[n], light[n]
            a_, b_ = np.int32(a & 0xFF00FF), np.int32(b & 0xFF00FF)
            c_, d_ = np.int32(c & 0xFF00FF), np.int32(d & 0xFF00FF)
            over = np.int32(np.int32(a_ << 5) + np.int32(right * np.int32(b_ - a_)))
            under = np.int32(np.int32(c_ << 5) + np.int32(right * np.int32(d_ - c_)))
            blue, blue_under = np.int32(over & 0xFFFF), np.int32(under & 0xFFFF)
            red, red_under = np.int32(over >> 16), np.int32(under >> 16)
            a_, b_ = np.int32(np.int32(a >> 8) & 0xFF), np.int32(np.int32(b >> 8) & 0xFF)
            c_, d_ = np.int32(np.int32(c >> 8) & 0xFF), np.int32(np.int32(d >> 8) & 0xFF)
            green = np.int32(np.int32(a_ << 5) + np.int32(right * np.int32(b_ - a_)))
            green_under = np.int32(np.int32(c_ << 5) + np.int32(right * np.int32(d_ - c_)))
            # Round to nearest, with halves rounded up; with light, halves are rounded to even.
            blue = np.int32(np.int32(np.int32(blue << 5) + np.int32(down * np.int32(blue_under - blue)) + 512) >> 10)
            green = np.int32(
                np.int32(np.int32(green << 5) + np.int32(down * np.int32(green_under - green)) + 512) >> 10
            )
            red = np.int32(np.int32(np.int32(red << 5) + np.int32(down * np.int32(red_under - red)) + 512) >> 10)
            blue, green, red = np.int32(blue * bright), np.int32(green * bright), np.int32(red * bright)
            blue = np.int32(np.int32(blue + 63 + np.int32(np.int32(blue >> 7) & 1)) >> 7)
            green = np.int32(np.int32(green + 63 + np.int32(np.int32(green >> 7) & 1)) >> 7)
            red = np.int32(np.int32(red + 63 + np.int32(np.int32(red >> 7) & 1)) >> 7)
            blue = blue if blue < 255 else np.int32(255)
            green = green if green < 255 else np.int32(255)
            red = red if red < 255 else np.int32(255)
            colours[n] = np.int32(blue | np.int32(green << 8) | np.int32(red << 16))
        for n in range(mixtures):
            spread, green_ = 0x20002, 2  # halves up
            for k in range(count_ + 4 * n, count_ + 4 * n + 4):
                spread += colours[k] & 0xFF00FF
                green_ += colours[k] >> 8 & 0xFF
            colours[mixed[n]] = spread >> 2 & 0xFF00FF | green_ >> 2 << 8
        for k in range(len(boxes)):
            height_, away_x, away_y, square = shadows[k, 0], shadows[k, 1], shadows[k, 2], shadows[k, 3]
            strength, thickness, more = shadows[k, 4], shadows[k, 5], shadows[k, 6]
            for row in range(max(first_row, boxes[k, 0]), min(last_row + 1, boxes[k, 1])):
                at_row = row * width - begin  # start of the row relative to the block; may lie outside it
                start = max(at_row + boxes[k, 2], 0)
                stop = max(min(at_row + boxes[k, 3], count_), start)
                xs, ys = flat_x[begin + start : begin + stop], flat_y[begin + start : begin + stop]
                ws, out = w_[start:stop], colours[start:stop]
                for n in range(len(out)):
                    depth[n] = one / ws[n]
                for n in range(len(out)):
                    off = abs((axes[2, 0] * xs[n] + axes[2, 1] * ys[n] + axes[2, 2]) * depth[n] - height_)
                    east = (axes[0, 0] * xs[n] + axes[0, 1] * ys[n] + axes[0, 2]) * depth[n] + away_x
                    north = (axes[1, 0] * xs[n] + axes[1, 1] * ys[n] + axes[1, 2]) * depth[n] + away_y
                    rim = one - (east * east + north * north) / square
                    rim = rim if rim > zero else zero
                    rim = rim if off < thickness * depth[n] + more else zero
                    shade[n] = np.int32(full - strength * rim * rim * (three - (rim + rim)))
                for n in range(len(out)):
                    # Divide by 255 with shifts, rounding to nearest.
                    dark = np.int32(np.int32(shade[n] * np.int32(out[n] & 0xFF00FF)) + 0x800080)
                    green = np.int32(np.int32(shade[n] * np.int32(np.int32(out[n] >> 8) & 0xFF)) + 0x80)
                    dark = np.int32(np.int32(np.int32(dark + np.int32(np.int32(dark >> 8) & 0xFF00FF)) >> 8) & 0xFF00FF)
                    green = np.int32(np.int32(green + np.int32(green >> 8)) & 0xFF00)
                    out[n] = np.int32(dark | green)
        # Each number's fourth byte falls on the first byte of the next pixel, which then overwrites it.
        bytes_ = packed[begin : begin + count_]
        for n in range(len(bytes_)):
            bytes_[n] = colours[n]
    for k in range(3):
        picture[height - 1, width - 1, k] = colours[count_ - 1] >> 8 * k & 0xFF
