from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skyloop.errors import UsageError
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.sim.render import SensorEffects

CLEAN = replace(FRONT_CAMERA, noise_sigma=0.0, vignetting=0.0, exposure_s=0.0)


def grey(value: int = 128) -> np.ndarray:
    return np.full((CLEAN.height, CLEAN.width, 3), value, np.uint8)


def test_a_clean_sensor_changes_nothing() -> None:
    picture = grey()
    assert SensorEffects(CLEAN).apply(picture, 0, np.ones(3)) is picture
    assert (picture == 128).all()


def test_noise_has_its_sigma_and_no_bias() -> None:
    picture = SensorEffects(replace(CLEAN, noise_sigma=4.0), seed=1).apply(grey(), 0).astype(float)
    assert picture.mean() == pytest.approx(128.0, abs=0.05)
    assert picture.std() == pytest.approx(4.0, abs=0.1)


def test_noise_depends_only_on_seed_and_number() -> None:
    noisy = replace(CLEAN, noise_sigma=4.0)
    one = SensorEffects(noisy, seed=1)
    first, second = one.apply(grey(), 0), one.apply(grey(), 1)
    assert not np.array_equal(first, second)
    assert np.array_equal(SensorEffects(noisy, seed=1).apply(grey(), 1), second)
    assert not np.array_equal(SensorEffects(noisy, seed=2).apply(grey(), 1), second)


def test_noise_saturates_instead_of_wrapping_around() -> None:
    effects = SensorEffects(replace(CLEAN, noise_sigma=10.0))
    assert effects.apply(grey(255), 0).min() > 180
    assert effects.apply(grey(0), 0).max() < 75


def test_vignetting_takes_its_share_from_the_corners_and_gain_brightens() -> None:
    dimmed = SensorEffects(replace(CLEAN, vignetting=0.5)).apply(grey(200), 0)
    assert dimmed[120, 160, 0] == pytest.approx(200, abs=2)
    assert dimmed[0, 0, 0] == pytest.approx(100, abs=3)
    assert SensorEffects(replace(CLEAN, exposure_gain=1.5)).apply(grey(100), 0)[50, 50, 0] == 150


def test_turning_left_blurs_along_the_rows_and_pitching_along_the_columns() -> None:
    dot = grey(0)
    dot[120, 160] = 255
    effects = SensorEffects(replace(CLEAN, exposure_s=0.02))
    level = effects.apply(dot.copy(), 0, np.array([0.0, 0.0, 2.0]))  # 0.04 rad of 244 px: 10 px
    rows, columns = np.nonzero(level[..., 0])
    assert set(rows) == {120}
    assert 8 <= np.ptp(columns) <= 11
    assert columns.mean() == pytest.approx(160)
    upright = effects.apply(dot.copy(), 0, np.array([0.0, 2.0, 0.0]))
    rows, columns = np.nonzero(upright[..., 0])
    assert set(columns) == {160}
    assert 8 <= np.ptp(rows) <= 11
    assert np.array_equal(effects.apply(dot.copy(), 0, np.array([0.0, 0.0, 0.1])), dot)


def test_another_cameras_picture_is_refused() -> None:
    with pytest.raises(UsageError, match="320x240"):
        SensorEffects(CLEAN).apply(np.zeros((10, 10, 3), np.uint8), 0)
