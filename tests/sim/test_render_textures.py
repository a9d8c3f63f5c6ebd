from __future__ import annotations

import numpy as np
import pytest

from skyloop.errors import UnknownNameError
from skyloop.sim.render.models import draw_card
from skyloop.sim.render.quads import BORDER, GAP, LEVELS, AtlasBuilder
from skyloop.sim.render.textures import draw_paint, draw_surface
from skyloop.sim.world import TEXTURES, MarkerPattern


@pytest.mark.parametrize("name", TEXTURES)
@pytest.mark.parametrize("size", [(1.2, 0.8), (0.12, 2.0)], ids=["wide", "sliver"])
def test_every_surface_is_reproducible_and_has_detail(name: str, size: tuple[float, float]) -> None:
    picture = draw_surface(name, *size, per_m=120.0)
    assert picture.shape == (max(4, round(size[1] * 120)), max(4, round(size[0] * 120)), 3)
    assert picture.dtype == np.uint8
    assert np.array_equal(picture, draw_surface(name, *size, per_m=120.0))
    assert picture.std(axis=(0, 1)).max() > 1.5


def test_an_unknown_surface_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(UnknownNameError, match="parquet"):
        draw_surface("parket", 1.0, 1.0, 50.0)


def test_paint_has_the_requested_colour() -> None:
    blue, green, red = draw_paint((200, 100, 50))[20:40, 20:40].mean(axis=(0, 1))
    assert (red, green, blue) == pytest.approx((200, 100, 50), rel=0.12)


def test_each_level_of_a_texture_is_at_its_computed_place_with_its_rim_repeated() -> None:
    builder = AtlasBuilder()
    rng = np.random.default_rng(2)
    pictures = [rng.integers(0, 255, (h, w, 3)).astype(np.uint8) for h, w in ((128, 64), (50, 200), (7, 7))]
    textures = [builder.add(k, pictures[k].copy) for k in range(3)]
    assert builder.add(1, lambda: pictures[0]) is textures[1]
    atlas = builder.pack()
    for texture, picture in zip(textures, pictures, strict=True):
        x, y, span = (int(a[texture.index]) for a in (atlas.x0, atlas.y0, atlas.span))
        assert np.array_equal(atlas.image[y : y + texture.height, x : x + texture.width, :3], picture)
        assert np.array_equal(atlas.image[y : y + texture.height, x - BORDER, :3], picture[:, 0])
        for level in range(1, LEVELS):
            left = x + span - (span >> level) + GAP * level
            size = (span // 2) >> level
            coarse = atlas.image[y : y + max(1, texture.height >> level), left : left + size, :3]
            assert np.abs(coarse.mean() - picture.mean()) < 25
            assert np.array_equal(atlas.image[y, left - BORDER], atlas.image[y, left])
            assert np.array_equal(atlas.image[y, left + size - 1 + BORDER], atlas.image[y, left + size - 1])


def test_a_marker_card_keeps_fractions_of_a_texel_in_its_margin() -> None:
    pattern = MarkerPattern("DICT_4X4_50", 0, 0.15, 0.0333)
    image, uv = draw_card(pattern)
    left, top, right, bottom = uv
    black = 6 * 24
    assert right - left == pytest.approx(black * pattern.card_size_m / pattern.size_m)
    assert (left, right) == (top, bottom)
    edge = round(left + pattern.margin_m / pattern.size_m * black)
    assert image[edge - 1, edge + 5, 0] > 200
    assert image[edge, edge + 5, 0] < 50
