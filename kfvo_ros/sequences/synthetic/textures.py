# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Procedural textures of rendered scenes, from lattice noise and rectangles.

Every function returns grey values (SIZE, SIZE) that repeat in both directions or, for objects
that are textured as a whole, fill the square. Only elementwise arithmetic is used, which NumPy
rounds alike on every platform.
"""

from __future__ import annotations

import numpy as np

from kfvo_ros.sequences.synthetic.rng import StableRng
from kfvo_ros.sequences.synthetic.scene import TEXTURE_SIZE as SIZE


def noise(rng: StableRng, rows: int, columns: int) -> np.ndarray:
    """Return periodic value noise (SIZE, SIZE) in [-1, 1] on a lattice of rows x columns."""
    lattice = 2.0 * rng.unit(rows, columns) - 1.0
    before, after, weight = _lattice_weights(rows)
    lines = lattice[before] * (1.0 - weight[:, None]) + lattice[after] * weight[:, None]
    before, after, weight = _lattice_weights(columns)
    return lines[:, before] * (1.0 - weight) + lines[:, after] * weight


def fractal(rng: StableRng, coarsest: int, finest: int, decay: float) -> np.ndarray:
    """Return fractal noise (SIZE, SIZE): octaves of `coarsest` to `finest` cells.

    The amplitude is multiplied by `decay` from one octave to the next.
    """
    total, amplitude, cells = np.zeros((SIZE, SIZE)), 1.0, coarsest
    while cells <= finest:
        total += amplitude * noise(rng, cells, cells)
        amplitude, cells = amplitude * decay, cells * 2
    return total


def _lattice_weights(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lattice indices before and after each texel, and the weight of the latter.

    All three are (SIZE,); the weight is a smoothstep.
    """
    position = np.arange(SIZE) * (count / SIZE)
    before = position.astype(np.int64)
    share = position - before
    return before, (before + 1) % count, share * share * (3.0 - 2.0 * share)


def plaster(rng: StableRng) -> np.ndarray:
    """Return a painted wall of very low contrast."""
    return 128.0 + 22.0 * fractal(rng, 2, 32, 0.75) + 14.0 * fractal(rng, 64, 256, 0.9)


def concrete(rng: StableRng) -> np.ndarray:
    """Return bare concrete with stains and pores."""
    wall = 120.0 + 22.0 * fractal(rng, 2, 64, 0.6)
    wall -= 270.0 * np.clip(noise(rng, 128, 128) - 0.8, 0.0, 1.0)
    return wall - 45.0 * np.clip(fractal(rng, 8, 32, 0.7) - 0.7, 0.0, 1.0)


def panels(rng: StableRng) -> np.ndarray:
    """Return plain wall panels with thin joints and a few screws: few corners."""
    wall = np.full((SIZE, SIZE), 150.0) + 3.0 * noise(rng, 4, 4)
    for joint in (0, 200, 390):
        wall[joint:joint + 4] = 70.0
        wall[joint + 4:joint + 6] = 185.0
    wall[:, :4] = 80.0
    wall[:, 4:6] = 180.0
    for row in (16, 184, 216, 374, 406, 496):
        for column in (18, 256, 490):
            wall[row:row + 6, column:column + 6] = 85.0
    return wall


def brick(rng: StableRng) -> np.ndarray:
    """Return a brick wall: sixteen courses of four bricks."""
    course, length, joint = SIZE // 16, SIZE // 4, 5
    wall = np.full((SIZE, SIZE), 165.0)
    for row in range(16):
        shift = (row % 2) * length // 2
        for column in range(4):
            rows = slice(row * course + joint, (row + 1) * course)
            columns = (np.arange(length - joint) + column * length + shift) % SIZE
            wall[rows, columns] = rng.between(70.0, 125.0)
    return wall + 7.0 * fractal(rng, 32, 256, 0.8)


def wallpaper(rng: StableRng) -> np.ndarray:
    """Return stripes with a motif, unevenly worn."""
    paper = np.full((SIZE, SIZE), 150.0)
    y, x = np.mgrid[:SIZE, :SIZE]
    step = SIZE // 8
    paper[:, (np.arange(SIZE) // (step // 2)) % 2 == 0] -= rng.between(15.0, 35.0)
    radius = rng.between(10.0, 18.0)
    squared = ((x + (y // step % 2) * (step // 2)) % step - step / 2) ** 2 + (
        y % step - step / 2) ** 2
    paper[squared < radius * radius] += rng.between(30.0, 60.0)
    paper[squared < 0.2 * radius * radius] -= 70.0
    return paper + 4.0 * fractal(rng, 4, 256, 0.85)


def planks(rng: StableRng) -> np.ndarray:
    """Return a wooden floor of eight planks with grain, each laid in two lengths."""
    width = SIZE // 8
    floor = np.empty((SIZE, SIZE))
    for plank in range(8):
        start = rng.integer(0, SIZE)
        rows = slice(plank * width, (plank + 1) * width)
        grey = np.full(SIZE, rng.between(95.0, 150.0))
        grey[(np.arange(SIZE // 2) + start) % SIZE] = rng.between(95.0, 150.0)
        grey[[start, (start + 1) % SIZE, (start + SIZE // 2) % SIZE]] = 55.0
        floor[rows] = grey
        floor[plank * width:plank * width + 2] = 50.0
    floor += 8.0 * noise(rng, 256, 8) + 7.0 * noise(rng, 128, 16)
    knots = np.clip(noise(rng, 32, 32) - 0.75, 0.0, 1.0)
    return floor - 220.0 * knots


def tiles(rng: StableRng) -> np.ndarray:
    """Return a floor of 8 x 8 tiles of slightly different grey values with dark joints."""
    side = SIZE // 8
    grey = np.where((np.add.outer(np.arange(8), np.arange(8)) % 2) == 0, 165.0,
                    rng.between(100.0, 155.0)) + 26.0 * (rng.unit(8, 8) - 0.5)
    floor = np.repeat(np.repeat(grey, side, axis=0), side, axis=1)
    floor += 4.0 * fractal(rng, 16, 256, 0.8)
    joint = np.arange(SIZE) % side < 3
    floor[joint] = floor[:, joint] = 70.0
    return floor


def carpet(rng: StableRng) -> np.ndarray:
    """Return a patterned carpet: nested diamonds on a woven ground."""
    y, x = np.mgrid[:SIZE, :SIZE]
    step = SIZE // 4
    ring = np.abs(x % step - step // 2) + np.abs(y % step - step // 2)
    greys = 70.0 + 110.0 * rng.unit(16)
    return greys[ring // 12] + 6.0 * noise(rng, 256, 256) + 8.0 * fractal(rng, 4, 64, 0.8)


def poster(rng: StableRng) -> np.ndarray:
    """Return a framed print: shapes of many sizes and a few lines of text."""
    sheet = np.full((SIZE, SIZE), rng.between(60.0, 220.0))
    sheet += rng.between(10.0, 40.0) * fractal(rng, 2, 16, 0.7)
    y, x = np.mgrid[:SIZE, :SIZE]
    for _ in range(rng.integer(14, 40)):
        row, column = rng.integer(0, SIZE), rng.integer(0, SIZE)
        height, width = rng.integer(12, 150), rng.integer(12, 150)
        grey = rng.between(15.0, 240.0)
        if rng.chance(0.6):
            sheet[row:row + height, column:column + width] = grey
        else:
            sheet[(x - column) ** 2 + (y - row) ** 2 < height * height // 4] = grey
    _write_text(rng, sheet)
    sheet[:14] = sheet[-14:] = sheet[:, :14] = sheet[:, -14:] = rng.between(20.0, 230.0)
    return sheet


def _write_text(rng: StableRng, sheet: np.ndarray) -> None:
    """Write a block of text, words of three to eight letters, on a light field."""
    top, left = rng.integer(30, SIZE // 2), rng.integer(30, SIZE // 2)
    height, width = rng.integer(80, 200), rng.integer(120, 220)
    sheet[top:top + height, left:left + width] = 215.0
    for row in range(top + 10, top + height - 14, 20):
        column = left + 10
        while column < left + width - 60:
            for _ in range(rng.integer(3, 9)):
                sheet[row:row + rng.integer(7, 12), column:column + rng.integer(2, 5)] = 40.0
                column += 6
            column += 10


def books(rng: StableRng) -> np.ndarray:
    """Return four shelves of books."""
    shelf = SIZE // 4
    case = np.full((SIZE, SIZE), 30.0)
    for top in range(0, SIZE, shelf):
        column = 8
        while column < SIZE - 12:
            width, height = rng.integer(9, 32), rng.integer(60, 112)
            column_end, bottom = min(column + width, SIZE - 8), top + shelf - 8
            grey = rng.between(45.0, 225.0)
            case[bottom - height:bottom, column:column_end] = grey
            band = bottom - rng.integer(20, height)
            case[band:band + rng.integer(4, 16), column:column_end] = rng.between(20.0, 240.0)
            case[bottom - height:bottom, column:column + 2] = 0.6 * grey
            column = column_end + (rng.integer(10, 50) if rng.chance(0.08) else 0)
        case[top + shelf - 8:top + shelf] = 130.0
    case[:, :8] = case[:, -8:] = 130.0
    return case


def door(rng: StableRng) -> np.ndarray:
    """Return a panelled door with a handle."""
    leaf = np.full((SIZE, SIZE), rng.between(110.0, 190.0)) + 5.0 * noise(rng, 16, 256)
    for top, bottom in ((40, 200), (235, 470)):
        for left in (50, 280):
            panel = leaf[top:bottom, left:left + 180]
            panel -= 35.0
            panel[8:-8, 8:-8] += 25.0
            panel[:5] -= 30.0
    leaf[240:262, 462:496] = 40.0
    leaf[:10] = leaf[:, :14] = leaf[:, -14:] = 65.0
    return leaf


def window(rng: StableRng) -> np.ndarray:
    """Return a bright window of six panes with a view of buildings."""
    view = np.repeat(np.linspace(235.0, 200.0, SIZE)[:, None], SIZE, axis=1)
    for _ in range(14):
        left, width, height = rng.integer(0, SIZE), rng.integer(40, 120), rng.integer(90, 330)
        grey = rng.between(120.0, 195.0)
        view[SIZE - height:, left:left + width] = grey
        view[SIZE - height + 12::24, left + 8:left + width - 8] = grey - 25.0
    view += 4.0 * fractal(rng, 2, 16, 0.8)
    for bar in (0, SIZE // 3, 2 * SIZE // 3, SIZE - 16):
        view[:, bar:bar + 16] = 165.0
        view[:, bar + 14:bar + 16] = 90.0
    for bar in (0, SIZE // 2, SIZE - 16):
        view[bar:bar + 16] = 170.0
        view[bar + 14:bar + 16] = 90.0
    return view


def cupboard(rng: StableRng) -> np.ndarray:
    """Return wooden doors and drawers with knobs."""
    front = np.full((SIZE, SIZE), rng.between(80.0, 165.0))
    front += 7.0 * noise(rng, 8, 128) + 4.0 * noise(rng, 16, 256)
    for top, bottom, columns in ((0, 300, 2), (300, 406, 3), (406, SIZE, 3)):
        width = SIZE // columns
        front[top:top + 5] = 40.0
        for column in range(columns):
            left = column * width
            front[top:bottom, left:left + 5] = 40.0
            row = (top + bottom) // 2
            knob = left + (width // 2 if columns == 3 else (width - 30 if column == 0 else 30))
            front[row - 9:row + 9, knob - 9:knob + 9] = 215.0
            front[row + 9:row + 13, knob - 9:knob + 9] = 35.0
    return front


def cardboard(rng: StableRng) -> np.ndarray:
    """Return the side of a parcel: tape, a label, scuffs."""
    side = 135.0 + 5.0 * noise(rng, 4, 256) + 6.0 * fractal(rng, 4, 64, 0.7)
    tape = rng.integer(180, 300)
    side[:, tape:tape + 60] += 30.0
    row, column = rng.integer(40, 300), rng.integer(20, 320)
    side[row:row + 130, column:column + 150] = 225.0
    for line in range(row + 14, row + 116, 16):
        side[line:line + 6, column + 12:column + rng.integer(60, 140)] = 45.0
    stamp_row, stamp_column = rng.integer(0, 400), rng.integer(0, 400)
    side[stamp_row:stamp_row + 60, stamp_column:stamp_column + 90] = 60.0
    side[stamp_row + 10:stamp_row + 50, stamp_column + 10:stamp_column + 80] = 130.0
    side[:4] = side[:, :4] = 60.0
    return side


def facade(rng: StableRng) -> np.ndarray:
    """Return the front of a house: rows of windows, a door, the edge of the roof."""
    front = np.full((SIZE, SIZE), rng.between(110.0, 190.0)) + 6.0 * fractal(rng, 8, 256, 0.8)
    rows, columns = rng.integer(2, 4), rng.integer(3, 6)
    height, width = (SIZE - 40) // rows, SIZE // columns
    frame, door = rng.between(60.0, 230.0), rng.integer(0, columns)
    for row in range(rows):
        for column in range(columns):
            top, left = 40 + row * height + height // 5, column * width + width // 4
            bottom, right = top + 3 * height // 5, left + width // 2
            if row == rows - 1 and column == door:
                bottom = SIZE
            front[top - 5:bottom + 5, left - 5:right + 5] = frame
            front[top:bottom, left:right] = rng.between(30.0, 110.0)
            front[top:bottom, (left + right) // 2 - 2:(left + right) // 2 + 2] = frame
            front[top + (bottom - top) // 3:top + (bottom - top) // 3 + 4, left:right] = frame
    front[:24] = rng.between(40.0, 100.0)
    return front


def leaves(rng: StableRng) -> np.ndarray:
    """Return foliage, of a hedge or a tree's crown: fractal noise at every scale."""
    return 95.0 + 30.0 * fractal(rng, 4, 128, 0.85)
