from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrgs_synth import textures

RNG = np.random.Generator
PALETTE = [(214, 120, 70), (250, 220, 160), (60, 90, 110)]
TEXTURES: dict[str, Callable[[RNG], np.ndarray]] = {
    "plain": lambda rng: textures.plain((200, 120, 80), rng),
    "wood": lambda rng: textures.wood(90, 160, 3, rng),
    "parquet": lambda rng: textures.parquet(160, 4, rng),
    "wallpaper": lambda rng: textures.wallpaper(128, 160, PALETTE[1], PALETTE[2], 32, rng),
    "geometric": lambda rng: textures.geometric(100, 140, PALETTE, 10, rng),
    "title_page": lambda rng: textures.title_page(140, 100, PALETTE, rng),
    "pages": lambda rng: textures.pages(40, 120, rng),
    "bands": lambda rng: textures.bands(64, 80, [(0.5, PALETTE[0]), (1.0, PALETTE[1])], rng),
    "speckles": lambda rng: textures.speckles(
        textures.plain((0, 0, 90), rng), PALETTE[1], 40, 3.0, rng
    ),
    "weave": lambda rng: textures.weave(80, 120, PALETTE[:2], PALETTE[1:], 8),
    "instrument_panel": lambda rng: textures.instrument_panel(80, 120, rng),
}


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_are_seeded_and_never_flat(name: str) -> None:
    texture = TEXTURES[name](np.random.default_rng(3))
    assert texture.dtype == np.uint8
    assert texture.ndim == 3
    assert texture.shape[2] == 3
    assert texture.astype(float).mean(axis=2).std() > 3.0
    np.testing.assert_array_equal(texture, TEXTURES[name](np.random.default_rng(3)))


def test_bands_follow_their_limits() -> None:
    texture = textures.bands(
        100, 20, [(0.25, (255, 0, 0)), (1.0, (0, 255, 0))], np.random.default_rng(0)
    )
    assert (texture[:25, :, 0] > 200).all()
    assert (texture[25:, :, 0] == 0).all()
    assert (texture[25:, :, 1] > 200).all()


def test_zigzag_closes_around_the_seam() -> None:
    black = np.zeros((100, 240, 3), dtype=np.uint8)
    drawn = textures.zigzag(black, (255, 255, 255), 0.5, 0.1, 6, 5)[..., 0] > 0
    assert np.abs(np.flatnonzero(drawn[:, 0]).mean() - np.flatnonzero(drawn[:, -1]).mean()) < 4
    assert not drawn[:30].any()
    assert not drawn[70:].any()


def test_hang_covers_the_wall_only_where_the_picture_is() -> None:
    wall = np.full((200, 300, 3), 9, dtype=np.uint8)
    picture = np.full((40, 60, 3), 77, dtype=np.uint8)
    hung = textures.hang(wall, picture, (100, 150))
    np.testing.assert_array_equal(hung[80:120, 120:180], picture)
    assert (hung[:50] == 9).all()
    assert (wall == 9).all()
