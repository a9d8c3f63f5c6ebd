"""The planar renderer's work as loops over quads and pixels, for Numba to compile (``compiled``).

They compute what ``visibility``, ``shading`` and ``shadows`` compute, operation by operation in the same order and the
same precision, so the picture is the same bit by bit; those modules explain the mathematics. They also run
uncompiled, slowly, which is how they are tested where Numba is not installed. Each is one flat function, because a
compiled one can't call one that is not. None holds the interpreter lock once compiled.

Inner loops are short, write one array each, and stay in single precision: only such become vector instructions.
Constants that other modules define are arguments: Numba's cache looks for changes in this file only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from skyloop.sim.render.quads import Floats

    Singles = NDArray[np.float32]
    Integers = NDArray[np.int32]

BLOCK = 512  # samples worked on at a time: few enough for the working arrays to stay in the cache
BAND = 16  # rows of the grid, likewise
_ROUND = np.float32(3 << 22)  # added and taken away, it rounds a number up to 2^22 to a whole one, halves to even


def prepare(
    corners: Floats,
    normals: Floats,
    u_slope: Floats,
    v_slope: Floats,
    u_start: Floats,
    v_start: Floats,
    two_sided: NDArray[np.bool_],
    lit: NDArray[np.bool_],
    shown: NDArray[np.bool_],
    weight: Floats,
    density: Floats,
    origin: Floats,
    position: Floats,
    rotation: Floats,
    constants: Floats,
    grid: Floats,
    pixel_area: float,
    edges: Floats,
    planes: Floats,
    box: NDArray[np.int64],
    table: Singles,
) -> int:
    """Select the quads that may be seen, as ``visible_quads`` and ``sampling_table`` do.

    Args:
        corners: As those after it, of ``Quads``.
        normals: See ``Quads``.
        u_slope: See ``Quads``.
        v_slope: See ``Quads``.
        u_start: See ``Quads``.
        v_start: See ``Quads``.
        two_sided: See ``Quads``.
        lit: See ``Quads``.
        shown: Whether a quad is to be drawn at all, (n,).
        weight: Of each quad's inverse depth, by its priority, (n,).
        density: See ``Quads``.
        origin: x, y and span in the atlas of each quad's texture, (n, 3).
        position: Of the camera.
        rotation: World from optical axes.
        constants: Edge-on limit [m], ambient light, direct light, unit of light, factor of the footprint,
            direction to the light, unit.
        grid: width, height, fx, fy, cx, cy.
        pixel_area: 1/(fx fy) of the image.
        edges: Is written: of each selected quad the planes through its edges: slopes on the grid along x and y, start,
            (n, 4, 3).
        planes: Is written: its 1/z on the grid as slope along x, slope along y and start, (n, 3).
        box: Is written: the grid's first row it may cover, the one after the last, and columns likewise, (n, 4).
        table: Is written: see ``sampling_table``, (13, n + 1).

    Returns:
        How many were selected.
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
        n0, n1, n2 = normals[k, 0], normals[k, 1], normals[k, 2]
        above = n0 * (p0 - corners[k, 0, 0]) + n1 * (p1 - corners[k, 0, 1]) + n2 * (p2 - corners[k, 0, 2])
        if not (above > edge_on or (two_sided[k] and above < -edge_on)):
            continue
        off_left = off_right = off_top = off_bottom = behind = True
        ahead = True
        for i in range(4):
            d0, d1, d2 = corners[k, i, 0] - p0, corners[k, i, 1] - p1, corners[k, i, 2] - p2
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
        if ahead:  # two samples to spare for rounding: the edges decide
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
        u0, u1, u2 = u_slope[k, 0], u_slope[k, 1], u_slope[k, 2]
        v0, v1, v2 = v_slope[k, 0], v_slope[k, 1], v_slope[k, 2]
        under_u = u0 * p0 + u1 * p1 + u2 * p2 + u_start[k] - origin[k, 2]
        under_v = v0 * p0 + v1 * p1 + v2 * p2 + v_start[k]
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


def fill(count: int, edges: Floats, planes: Floats, box: NDArray[np.int64], nearest: Singles, seen: Integers) -> None:
    """Find the nearest quad at each sample, as ``DepthBuffer`` does.

    Args:
        count: What :func:`prepare` returned, and it wrote the next three.
        edges: See :func:`prepare`.
        planes: See :func:`prepare`.
        box: See :func:`prepare`.
        nearest: Is used: 1/z at each sample of a band, (BAND, width).
        seen: Is written: the table's column for each sample, 0 where there is nothing, (height, width).
    """
    height, width = seen.shape
    wide = float(width)
    along = np.empty((count, width), np.float32)
    for k in range(count):
        for column in range(box[k, 2], box[k, 3]):
            along[k, column] = planes[k, 0] * column
    for top in range(0, height, BAND):
        nearest[:] = 0.0
        seen[top : top + BAND] = 0
        for k in range(count):
            number = np.int32(k + 1)
            for row in range(max(top, box[k, 0]), min(top + BAND, box[k, 1])):
                low, high = -1.0, wide
                for i in range(4):
                    crossing = (edges[k, i, 1] * row + edges[k, i, 2]) / -edges[k, i, 0]
                    if edges[k, i, 0] > 0.0:
                        low = max(low, crossing)
                    else:
                        high = min(high, crossing)
                first = int(np.ceil(min(max(low, 0.0), wide)))
                end = int(np.floor(min(max(high, -1.0), wide - 1.0))) + 1
                if first >= end:
                    continue
                down = np.float32(planes[k, 1] * row + planes[k, 2])
                near, numbers, across = nearest[row - top, first:end], seen[row, first:end], along[k, first:end]
                for n in range(end - first):
                    candidate = across[n] + down
                    closer = candidate > near[n]
                    near[n] = candidate if closer else near[n]
                    numbers[n] = number if closer else numbers[n]


def resolve(seen: Integers, lookup: NDArray[np.uint32], numbers: Integers, mixed: Integers) -> int:
    """Find what each pixel shows.

    Args:
        seen: Of :func:`fill`, flat.
        lookup: Places in it of each pixel's samples, (1 or 4, pixels).
        numbers: Is written: the table's column for each pixel's first sample, (pixels,).
        mixed: Is written: the pixels whose samples see different quads, as many as are returned, (pixels,).

    Returns:
        How many pixels that are.
    """
    first = lookup[0]
    count = 0
    if len(lookup) == 1:
        for pixel in range(len(numbers)):
            numbers[pixel] = seen[first[pixel]]
    else:
        second, third, fourth = lookup[1], lookup[2], lookup[3]
        for pixel in range(len(numbers)):
            number = seen[first[pixel]]
            numbers[pixel] = number
            others = seen[second[pixel]] ^ number | seen[third[pixel]] ^ number | seen[fourth[pixel]] ^ number
            mixed[np.uint64(count)] = pixel
            count += others != 0
    return count


def shade(
    table: Singles,
    numbers: Integers,
    ray_x: Singles,
    ray_y: Singles,
    atlas: Integers,
    gap: float,
    farthest: float,
    colours: Integers,
    inverse_depth: Singles,
) -> None:
    """Write the colours and inverse depths of samples, as ``Shader`` does.

    Args:
        table: Of :func:`prepare`.
        numbers: The table's column for each sample, (n,).
        ray_x: x of the ray (x, y, 1), (n,).
        ray_y: y of the ray, (n,).
        atlas: Its texels, BGRA in one number each.
        gap: Between two levels of a texture in the atlas [texels].
        farthest: 1/z that a ray past a quad's horizon is taken to have [1/m].
        colours: Is written: BGRA in one number, A is 0, (n,).
        inverse_depth: Is written [1/m], (n,).
    """
    zero, half, one, full = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(255.0)
    parts, whole = np.float32(32.0), np.float32(1.0 / 1024.0)  # a texel has 32 parts along each side
    unit, second, third = np.float32(1.0 / 128.0), np.float32(256.0), np.float32(65536.0)
    most_u, most_v = np.float32(atlas.shape[1] - 2), np.float32(atlas.shape[0] - 2)
    between, far = np.float32(gap), np.float32(farthest)
    stride = atlas.shape[1]
    texels = atlas.reshape(-1)
    one_on, one_down = np.uint64(1), np.uint64(stride)  # unsigned: Numba counts no place from the end
    u_, v_, w_ = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    left, top, light = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    size, level, scale = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    at_u, at_v = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    corner = np.empty((4, BLOCK), np.int32)
    c0, c1, c2, c3 = corner[0], corner[1], corner[2], corner[3]
    for first in range(0, len(numbers), BLOCK):
        count = min(BLOCK, len(numbers) - first)
        block, out, ws = (
            numbers[first : first + count],
            colours[first : first + count],
            inverse_depth[first : first + count],
        )
        start = 0
        while start < count:
            number = block[start]
            end = start + 1
            while end < count and block[end] == number:
                end += 1
            # A little beyond the run, so that there is no rest; the next run overwrites it.
            stop = min(start + (end - start + 31) // 32 * 32, count)
            xs, ys = ray_x[first + start : first + stop], ray_y[first + start : first + stop]
            into = w_[start:stop]
            p, q, r = table[6, number], table[7, number], table[8, number]
            for n in range(len(into)):
                into[n] = p * xs[n] + q * ys[n] + r
            into = u_[start:stop]
            p, q, r = table[0, number], table[1, number], table[2, number]
            for n in range(len(into)):
                into[n] = p * xs[n] + q * ys[n] + r
            into = v_[start:stop]
            p, q, r = table[3, number], table[4, number], table[5, number]
            for n in range(len(into)):
                into[n] = p * xs[n] + q * ys[n] + r
            size[start:stop] = table[9, number]
            left[start:stop] = table[10, number]
            top[start:stop] = table[11, number]
            light[start:stop] = np.float32(int(table[12, number]))
            start = end
        for n in range(count):
            ws[n] = w_[n] if w_[n] > far else far
        for n in range(count):
            inverse = one / ws[n]
            area = size[n] * inverse * inverse * inverse
            at = zero
            at = at if area < np.float32(4.0) else one
            at = at if area < np.float32(16.0) else np.float32(2.0)
            at = at if area < np.float32(64.0) else np.float32(3.0)
            at = at if area < np.float32(256.0) else np.float32(4.0)
            at = at if area < np.float32(1024.0) else np.float32(5.0)
            at = at if area < np.float32(4096.0) else np.float32(6.0)
            level[n] = at
        for n in range(count):
            at, by = level[n], one
            by = by if at < one else half
            by = by if at < np.float32(2.0) else np.float32(0.25)
            by = by if at < np.float32(3.0) else np.float32(0.125)
            by = by if at < np.float32(4.0) else np.float32(0.0625)
            by = by if at < np.float32(5.0) else np.float32(0.03125)
            by = by if at < np.float32(6.0) else np.float32(0.015625)
            scale[n] = one / ws[n] * by
        for n in range(count):
            u = u_[n] * scale[n] + between * level[n] + left[n]
            u = u if u > zero else zero
            u = u if u < most_u else most_u
            at_u[n] = np.int32(u * parts + _ROUND - _ROUND)
        for n in range(count):
            v = v_[n] * scale[n] + top[n]
            v = v if v > zero else zero
            v = v if v < most_v else most_v
            at_v[n] = np.int32(v * parts + _ROUND - _ROUND)
        for n in range(count):
            spot = np.uint64((at_v[n] >> 5) * stride + (at_u[n] >> 5))
            c0[n], c1[n] = texels[spot], texels[spot + one_on]
            c2[n], c3[n] = texels[spot + one_down], texels[spot + one_down + one_on]
        for n in range(count):
            right, below = np.float32(np.int32(at_u[n] & 31)), np.float32(np.int32(at_v[n] & 31))
            s0, s1 = (parts - right) * (parts - below), right * (parts - below)
            s2, s3 = (parts - right) * below, right * below
            # Whole numbers below 2^24, hence exact. Rounded to the nearest, halves up; with light, halves to even.
            blue = np.float32(np.int32(c0[n] & 255)) * s0 + np.float32(np.int32(c1[n] & 255)) * s1
            blue += np.float32(np.int32(c2[n] & 255)) * s2 + np.float32(np.int32(c3[n] & 255)) * s3
            green = np.float32(np.int32(c0[n] >> 8 & 255)) * s0 + np.float32(np.int32(c1[n] >> 8 & 255)) * s1
            green += np.float32(np.int32(c2[n] >> 8 & 255)) * s2 + np.float32(np.int32(c3[n] >> 8 & 255)) * s3
            red = np.float32(np.int32(c0[n] >> 16 & 255)) * s0 + np.float32(np.int32(c1[n] >> 16 & 255)) * s1
            red += np.float32(np.int32(c2[n] >> 16 & 255)) * s2 + np.float32(np.int32(c3[n] >> 16 & 255)) * s3
            blue = np.float32(np.int32(blue * whole + half)) * light[n] * unit + _ROUND - _ROUND
            green = np.float32(np.int32(green * whole + half)) * light[n] * unit + _ROUND - _ROUND
            red = np.float32(np.int32(red * whole + half)) * light[n] * unit + _ROUND - _ROUND
            blue = blue if blue < full else full
            green = green if green < full else full
            red = red if red < full else full
            out[n] = np.int32(blue + green * second + red * third)


def darken(
    picture: NDArray[np.uint8],
    ray_x: Singles,
    ray_y: Singles,
    inverse_depth: Singles,
    box: tuple[int, int, int, int],
    axes: Singles,
    shadow: Singles,
) -> None:
    """Darken what shows a shadow's place, as ``shadows.darken`` does.

    Args:
        picture: BGR, (height, width, 3), changed in place.
        ray_x: Of each pixel, (height, width).
        ray_y: Of each pixel, (height, width).
        inverse_depth: Of each pixel, (height, width).
        box: First row, row after the last, first column, column after the last.
        axes: World from optical.
        shadow: Numbers of ``shadows.Placed``: below, away x, away y, squared radius, strength, thickness, more of it.
    """
    zero, one, three, full = np.float32(0.0), np.float32(1.0), np.float32(3.0), np.float32(255.0)
    above, away_x, away_y, square = shadow[0], shadow[1], shadow[2], shadow[3]
    strength, thickness, more = shadow[4], shadow[5], shadow[6]
    a0, a1, a2, b0, b1, b2 = axes[0, 0], axes[0, 1], axes[0, 2], axes[1, 0], axes[1, 1], axes[1, 2]
    c0, c1, c2 = axes[2, 0], axes[2, 1], axes[2, 2]
    depth, light = np.empty(box[3] - box[2], np.float32), np.empty(box[3] - box[2], np.int32)
    for row in range(box[0], box[1]):
        xs, ys, ws = ray_x[row, box[2] : box[3]], ray_y[row, box[2] : box[3]], inverse_depth[row, box[2] : box[3]]
        out = picture[row, box[2] : box[3]]
        for n in range(len(light)):
            depth[n] = one / ws[n]
        for n in range(len(light)):
            off = abs((c0 * xs[n] + c1 * ys[n] + c2) * depth[n] - above)
            at_x = (a0 * xs[n] + a1 * ys[n] + a2) * depth[n] + away_x
            at_y = (b0 * xs[n] + b1 * ys[n] + b2) * depth[n] + away_y
            rim = one - (at_x * at_x + at_y * at_y) / square
            rim = rim if rim > zero else zero
            rim = rim if off < thickness * depth[n] + more else zero
            light[n] = np.int32(full - strength * rim * rim * (three - (rim + rim)))
        for n in range(len(light)):
            if light[n] < 255:
                for channel in range(3):
                    # The nearest to a 255th, by shifts.
                    product = light[n] * out[n, channel] + 128
                    out[n, channel] = (product + (product >> 8)) >> 8
