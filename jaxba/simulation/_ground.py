"""A ground to photograph: a height function, and a painted texture draped over it.

The texture is a picture of a small countryside: fields of several colours with soft borders, a road, bushes and stones,
shaded by the terrain's slope, with noise of all sizes from one texel to some metres, so that feature detectors find
distinct points at every scale, and no pattern that repeats. Targets of surveyed points are black and white quarters of
a disc, drawn with their centres where they truly are, between texels.

13 million texels take 1.5 s and 0.2 GB on one core.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxba.simulation._flight import Terrain

TARGET_RADIUS_M = 0.6

_COARSE = 4  # texels over a step of the colour map; its borders need no more
_FIELD_M = 28.0  # between the middles of fields
_FIELDS_BGR = np.array(
    [[62, 118, 96], [58, 98, 82], [88, 150, 158], [104, 140, 150], [70, 110, 128], [76, 132, 112], [120, 158, 176]]
)
_ROAD_BGR, _ROAD_WIDTH_M = np.array([150, 158, 166]), 5.0
_BUSH_BGR, _STONE_BGR = np.array([38, 62, 46]), np.array([168, 176, 182])
_GREY = 110.0  # of the middle field
# noise over 1, 2, 4, ... texels, shares of the colour: SIFT finds 4500 to 6600 points in the 1200 x 900 pixels of a
# simulated survey, enough to match well and few enough to match fast (0.085 throughout: up to 14,000)
_OCTAVE_STD = (0.042, 0.053, 0.063, 0.072, 0.078, 0.08, 0.08, 0.08)
_SUN = np.array([-0.45, 0.45, 0.77])  # east, north, up, to the sun


@dataclass(frozen=True, eq=False)
class Ground:
    """A terrain and its texture.

    - `terrain`: height in metres at (east, north).
    - `texture`: blue, green, red; the first texel lies in the north-west and rows run south.
    - `west_m`, `north_m`: outer edges of the first texel. `texel_m`: its side.
    """

    terrain: Terrain
    texture: UInt8[np.ndarray, "rows columns 3"]
    west_m: float
    north_m: float
    texel_m: float


def paint_ground(
    rng: np.random.Generator,
    terrain: Terrain,
    *,
    low_m: Float[np.ndarray, "2"],
    high_m: Float[np.ndarray, "2"],
    texel_m: float,
    targets_m: Float[np.ndarray, "targets 2"],
) -> Ground:
    """Return a ground that covers east and north from `low_m` to `high_m`, with targets at `targets_m`.

    >>> flat = lambda plan: np.zeros(len(plan))
    >>> ends = {"low_m": np.array([0.0, 0.0]), "high_m": np.array([8.0, 6.0])}
    >>> ground = paint_ground(np.random.default_rng(0), flat, **ends, texel_m=0.1, targets_m=np.empty((0, 2)))
    >>> ground.texture.shape
    (60, 80, 3)
    """
    columns, rows = (np.ceil((high_m - low_m) / (texel_m * _COARSE) - 1e-9).astype(int) * _COARSE).tolist()
    west, north = float(low_m[0]), float(high_m[1])
    east_m = west + (np.arange(columns // _COARSE) + 0.5) * (texel_m * _COARSE)
    north_m = north - (np.arange(rows // _COARSE) + 0.5) * (texel_m * _COARSE)
    colour = _colour_map(rng, east_m, north_m, terrain)
    noise = _noise(rng, rows, columns)
    texture = np.empty((rows, columns, 3), np.uint8)
    for channel in range(3):
        fine = cv2.resize(np.ascontiguousarray(colour[..., channel]), (columns, rows), interpolation=cv2.INTER_LINEAR)
        fine += noise * (0.5 * fine + 0.5 * _GREY)  # dark fields have texture, too
        texture[..., channel] = np.clip(np.rint(fine, out=fine), 0, 255, out=fine)
    ground = Ground(terrain, texture, west, north, texel_m)
    _scatter(rng, ground)
    for target in targets_m:
        _paint_target(ground, target)
    return ground


def _colour_map(
    rng: np.random.Generator,
    east_m: Float[np.ndarray, " columns"],
    north_m: Float[np.ndarray, " rows"],
    terrain: Terrain,
) -> Float[np.ndarray, "rows columns 3"]:
    """Return fields and a road under the sun, blue, green, red."""
    shape = (len(north_m), len(east_m))
    east, north = np.meshgrid(east_m, north_m)
    # borders wander by some metres
    step_m = east_m[1] - east_m[0]
    wander = [_smooth(rng, shape, round(6.0 / step_m) + 1) * 2.0 for _ in range(2)]
    low, high = np.array([east_m[0], north_m[-1]]), np.array([east_m[-1], north_m[0]])
    count = max(2, round(float(np.prod(high - low)) / _FIELD_M**2))
    middles = rng.uniform(low, high, size=(count, 2))
    nearest = np.full(shape, np.inf, np.float32)
    field = np.zeros(shape, np.int32)
    for number, middle in enumerate(middles):
        distance = ((east + wander[0] - middle[0]) ** 2 + (north + wander[1] - middle[1]) ** 2).astype(np.float32)
        closer = distance < nearest
        nearest[closer], field[closer] = distance[closer], number
    tints = _FIELDS_BGR[rng.integers(len(_FIELDS_BGR), size=count)] * rng.uniform(0.85, 1.15, size=(count, 1))
    colour = tints[field].astype(np.float32)
    middle_m = float(rng.uniform(*np.quantile(north_m, [0.35, 0.65])))
    off_road = np.abs(north - middle_m - 9.0 * np.sin(east / 31.0) - 0.12 * east + 0.15 * wander[0])
    cover = np.clip((_ROAD_WIDTH_M / 2 - off_road) / 0.4 + 0.5, 0, 1)[..., None].astype(np.float32)
    colour += cover * (_ROAD_BGR.astype(np.float32) - colour)
    height = terrain(np.column_stack([east.ravel(), north.ravel()])).reshape(shape)
    slope_south, slope_east = np.gradient(height, step_m)
    normal = np.stack([-slope_east, slope_south, np.ones(shape)], axis=-1)
    light = normal @ _SUN / np.linalg.norm(normal, axis=-1) / _SUN[2]
    return colour * light[..., None].astype(np.float32)


def _noise(rng: np.random.Generator, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
    """Return noise around 0 that varies over 1, 2, 4, ... texels."""
    total = np.zeros((rows, columns), np.float32)
    for octave, std in enumerate(_OCTAVE_STD):
        total += std * _smooth(rng, (rows, columns), 2**octave)
    return total


def _smooth(rng: np.random.Generator, shape: tuple[int, int], step: int) -> Float[np.ndarray, "rows columns"]:
    """Return normal noise given every `step` cells and cubic in between."""
    grid = rng.standard_normal((shape[0] // step + 3, shape[1] // step + 3), dtype=np.float32)
    if step == 1:
        return grid[: shape[0], : shape[1]]
    wide = cv2.resize(grid, None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC)
    return wide[step : step + shape[0], step : step + shape[1]]


def _scatter(rng: np.random.Generator, ground: Ground) -> None:
    """Paint bushes and stones, 0.15 to 1.2 m wide, one in 12 square metres."""
    rows, columns = ground.texture.shape[:2]
    count = round(rows * columns * ground.texel_m**2 / 12)
    places = rng.uniform([0, 0], [columns, rows], size=(count, 2))
    radii = np.exp(rng.uniform(np.log(0.15), np.log(1.2), size=(count, 2))) / 2 / ground.texel_m
    tints = np.where(rng.random((count, 1)) < 0.6, _BUSH_BGR, _STONE_BGR) * rng.uniform(0.8, 1.2, size=(count, 1))
    turns = rng.uniform(0, 180, size=count)
    for place, radius, tint, turn in zip(places, radii, tints, turns, strict=True):
        center = (round(16 * place[0] - 8), round(16 * place[1] - 8))  # OpenCV: 1/16 pixel, first centre at 0
        axes = (round(16 * radius[0]) + 1, round(16 * radius[1]) + 1)
        cv2.ellipse(ground.texture, _box(center, axes, turn), tint.tolist(), -1, cv2.LINE_AA)


def _box(center: tuple[int, int], axes: tuple[int, int], turn: float) -> tuple:
    return (center[0] / 16, center[1] / 16), (axes[0] / 8, axes[1] / 8), turn


def _paint_target(ground: Ground, target_m: Float[np.ndarray, "2"]) -> None:
    """Paint a disc in black and white quarters, and a white ring, each texel the mean of 16 x 16 samples."""
    samples = 16
    reach = int(np.ceil(TARGET_RADIUS_M / ground.texel_m)) + 1
    column, row = (target_m[0] - ground.west_m) / ground.texel_m, (ground.north_m - target_m[1]) / ground.texel_m
    left, top = int(column) - reach, int(row) - reach
    width = 2 * reach + 1
    at = (np.arange(width * samples) + 0.5) / samples
    x, y = np.meshgrid((at + left - column) * ground.texel_m, (at + top - row) * ground.texel_m)
    radius = np.hypot(x, y)
    white = (x * y > 0) | (radius > 0.9 * TARGET_RADIUS_M)
    value, inside = _mean(np.where(white, 245.0, 12.0), samples), _mean(radius < TARGET_RADIUS_M, samples)
    patch = ground.texture[top : top + width, left : left + width]
    patch[:] = np.rint(patch + inside[..., None] * (value[..., None] - patch)).astype(np.uint8)


def _mean(fine: np.ndarray, samples: int) -> Float[np.ndarray, "n n"]:
    n = len(fine) // samples
    return fine.reshape(n, samples, n, samples).mean(axis=(1, 3))
