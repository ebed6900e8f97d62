"""Geometry of a synthetic UAV block: flight plan, terrain, and which image sees which point.

The costly part is visibility: one pass over the images, each against the points in a strip of the block, sorted once by
their northing (2000 images and 170k points: 0.4 s), then one projection of all pairs that are left.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.geometry import AbstractCamera

Terrain = Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, " n"]]
"""Height over the mean terrain, metres, at (east, north)."""

MIN_POINTS_PER_IMAGE = 20

FlightPattern = Literal["lines", "crossing", "second", "orbit"]


@dataclass(frozen=True)
class Tracks:
    """Points, and where images see them without noise; ordered by point, then image.

    The first `num_marks` points are marks, seen in every image that they lie in; the others are tie points.
    """

    points: Float[np.ndarray, "points 3"]
    image_index: Int[np.ndarray, " observations"]
    point_index: Int[np.ndarray, " observations"]
    xy_px: Float[np.ndarray, "observations 2"]
    num_marks: int


@dataclass(frozen=True)
class Images:
    """Where images were taken, with what, and how far they see.

    - `frame_px`: lowest and highest pixel coordinates. `border_px`: kept free of observations on all sides.
    - `view`: lowest and highest x/z and y/z in view.
    """

    centers: Float[np.ndarray, "images 3"]
    rotations: Float[np.ndarray, "images 3 3"]
    cameras: AbstractCamera
    camera_index: Int[np.ndarray, " images"]
    frame_px: Float[np.ndarray, "2 2"]
    border_px: float
    view: Float[np.ndarray, "2 2"]


def field_of_view(camera: AbstractCamera, frame_px: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
    """Return the lowest and the highest x/z and y/z that an image sees, found by walking out from the axis.

    The walk ends where it first leaves the image, so a distortion that folds back far outside does no harm.
    """
    steps = np.linspace(0.0, 4.0, 8001)
    directions = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)], float)
    # the diagonals run through the corners
    half = (frame_px[1] - frame_px[0]) / 2
    directions *= half / half.max()
    walks = steps[:, None] * directions[:, None]
    xy = project(camera, np.concatenate([walks, np.ones_like(walks[..., :1])], axis=-1))
    outside = np.any((xy < frame_px[0]) | (xy > frame_px[1]), axis=-1)
    last = np.where(outside.any(axis=1), np.argmax(outside, axis=1), len(steps)) - 1
    if np.any(last < 1):
        raise JaxbaError("camera: its axis does not lie in the image; check the principal point and image_size_px.")
    edge = walks[np.arange(len(walks)), last]
    return np.stack([edge.min(axis=0), edge.max(axis=0)])


def flight_plan(
    num_images: int,
    base_m: float,
    spacing_m: float,
    num_lines: int | None = None,
    *,
    flight: FlightPattern = "lines",
    radius_m: float = 0.0,
) -> tuple[Float[np.ndarray, "images 2"], Rotation]:
    """Return the planned (east, north) of each image, centred on the origin, and its level attitude `cam_from_world`.

    Lines run north, then south, and so on eastwards, `spacing_m` apart, with an image every `base_m`. Without
    `num_lines` a flight is about square, of two lines at least from four images on. The second half of "crossing" and
    "second" is a flight of its own over the same place, along east and west for "crossing". "orbit" is a circle of
    `radius_m` whose cameras look inwards, 45 degrees down.
    """
    if flight == "orbit":
        angle = 2 * np.pi * np.arange(num_images) / num_images
        outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(num_images)], axis=1)
        up = np.array([0.0, 0.0, 1.0])
        axes = np.cross(up, outward), (outward - up) / np.sqrt(2), (-outward - up) / np.sqrt(2)
        return radius_m * outward[:, :2], Rotation.from_matrix(np.stack(axes, axis=1))
    if flight == "lines":
        return _lines(num_images, base_m, spacing_m, num_lines)
    first, first_level = _lines(num_images - num_images // 2, base_m, spacing_m, num_lines)
    second, second_level = _lines(num_images // 2, base_m, spacing_m, num_lines)
    if flight == "crossing":
        turn = Rotation.from_euler("z", 90, degrees=True)
        second, second_level = second[:, ::-1] * [-1.0, 1.0], second_level * turn.inv()
    return np.concatenate([first, second]), Rotation.concatenate([first_level, second_level])


def _lines(
    num_images: int, base_m: float, spacing_m: float, num_lines: int | None
) -> tuple[Float[np.ndarray, "images 2"], Rotation]:
    if num_lines is None:
        num_lines = max(2 if num_images >= 4 else 1, round(np.sqrt(num_images * base_m / spacing_m)))
    per_line = np.array([len(part) for part in np.array_split(np.arange(num_images), num_lines)])
    line = np.repeat(np.arange(num_lines), per_line)
    along = np.arange(num_images) - (np.cumsum(per_line) - per_line)[line]
    southward = line % 2 == 1
    along = np.where(southward, per_line.max() - 1 - along, along)
    east = (line - (num_lines - 1) / 2) * spacing_m
    north = (along - (per_line.max() - 1) / 2) * base_m
    level = np.where(southward[:, None], [-1.0, 1.0, -1.0], [1.0, -1.0, -1.0])
    return np.stack([east, north], axis=1), Rotation.from_matrix(level[:, :, None] * np.eye(3))


def smooth_terrain(rng: np.random.Generator, relief_m: float, height_m: float) -> Terrain:
    """Return a terrain of random waves, 1.5 to 6 flying heights long, within half of `relief_m` of its mean."""
    length, azimuth, phase = rng.uniform([[1.5], [0.0], [0.0]], [[6.0], [2 * np.pi], [2 * np.pi]], size=(3, 8))
    wave = 2 * np.pi / (length * height_m) * np.stack([np.sin(azimuth), np.cos(azimuth)])

    def terrain(east_north: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        return relief_m / 2 * np.tanh(np.cos(east_north @ wave + phase).sum(axis=1) / 2)

    return terrain


def make_tracks(
    rng: np.random.Generator,
    images: Images,
    terrain: Terrain,
    *,
    reach_m: Float[np.ndarray, "2"],
    beyond_m: Float[np.ndarray, "2"],
    num_tie: int,
    mean_length: float,
    num_marks: int,
) -> Tracks:
    """Return `num_marks` marks and `num_tie` tie points with their image points.

    `reach_m` is how far east and north of its station an image may see. Tie points are drawn evenly over the block and
    `beyond_m` its outermost stations, are detected in each image that they lie in with one probability, and stay if
    detected twice.
    """
    low, high = images.centers[:, :2].min(axis=0), images.centers[:, :2].max(axis=0)
    # additive recurrence: any first few of the marks are spread evenly (Roberts 2018)
    spread = (0.5 + np.arange(1, num_marks + 1)[:, None] * [0.7548776662, 0.5698402910]) % 1.0
    marks = low + spread * (high - low)
    for surplus in (1.3, 4.0, 16.0):
        ties = rng.uniform(low - beyond_m, high + beyond_m, size=(round(surplus * num_tie), 2))
        plan = np.concatenate([marks, ties])
        points = np.column_stack([plan, terrain(plan)])
        image, point, xy = _in_view(images, points, reach_m)
        probability = _detection_probability(np.bincount(point, minlength=len(points))[num_marks:], mean_length)
        found = (point < num_marks) | (rng.random(len(point)) < probability)
        image, point, xy = image[found], point[found], xy[found]
        twice = np.bincount(point, minlength=len(points)) >= 2
        twice[:num_marks] = True
        if np.count_nonzero(twice) >= num_marks + num_tie:
            break
    kept = np.flatnonzero(twice)[: num_marks + num_tie]
    number = np.full(len(points), -1, np.int32)
    number[kept] = np.arange(len(kept))
    order = np.argsort(point, kind="stable")
    order = order[number[point[order]] >= 0]
    tracks = Tracks(points[kept], image[order], number[point[order]], xy[order], num_marks)
    _check(tracks, len(images.centers))
    return tracks


@eqx.filter_jit
def _project(camera: AbstractCamera, x: jax.Array, y: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    return camera.project_components(x, y, z)


def project(camera: AbstractCamera, point_in_cam: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Return pixels, through the camera model, in float64 whatever jax is set to."""
    with jax.enable_x64(True):
        u, v = _project(camera, *np.moveaxis(point_in_cam, -1, 0))
        return np.stack([np.asarray(u), np.asarray(v)], axis=-1)


def cameras_of(cameras: AbstractCamera, index: Int[np.ndarray, " n"]) -> AbstractCamera:
    """Return the camera of each index; a single camera as scalars."""
    if np.size(cameras.focal_and_center()[0]) == 1:
        index = np.array(0)
    return jax.tree.map(lambda column: column[index], cameras)


def _in_view(
    images: Images, points: Float[np.ndarray, "points 3"], reach_m: Float[np.ndarray, "2"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Return all pairs of an image and a point in it, ordered by image, and the pixels."""
    by_north = np.argsort(points[:, 1]).astype(np.int32)
    points = points[by_north]
    firsts = np.searchsorted(points[:, 1], images.centers[:, 1] - reach_m[1])
    lasts = np.searchsorted(points[:, 1], images.centers[:, 1] + reach_m[1])
    seen, in_cam = [], []
    for center, rotation, first, last in zip(images.centers, images.rotations, firsts, lasts, strict=True):
        near = first + np.flatnonzero(np.abs(points[first:last, 0] - center[0]) < reach_m[0])
        p = (points[near] - center) @ rotation.T
        view = images.view * p[:, 2, None, None]
        ahead = np.flatnonzero((p[:, 2] > 0) & np.all((p[:, :2] > view[:, 0]) & (p[:, :2] < view[:, 1]), axis=1))
        seen.append(by_north[near[ahead]])
        in_cam.append(p[ahead])
    image = np.repeat(np.arange(len(seen), dtype=np.int32), [len(s) for s in seen])
    xy = project(cameras_of(images.cameras, images.camera_index[image]), np.concatenate(in_cam))
    low, high = images.frame_px[0] + images.border_px, images.frame_px[1] - images.border_px
    inside = np.all((xy > low) & (xy < high), axis=1)
    return image[inside], np.concatenate(seen)[inside], xy[inside]


def _detection_probability(views: Int[np.ndarray, " points"], mean_length: float) -> float:
    """Return the probability of detection that gives tracks this mean length, single sightings left out."""
    n, count = np.unique(views[views >= 2], return_counts=True)
    low, high = 0.0, 1.0
    for _ in range(40):
        p = (low + high) / 2
        once = n * p * (1 - p) ** (n - 1)
        tracks, observations = count @ (1 - (1 - p) ** n - once), count @ (n * p - once)
        low, high = (p, high) if observations < mean_length * tracks else (low, p)
    return high


def _check(tracks: Tracks, num_images: int) -> None:
    """Raise where an image or a mark is seen too little, or the block is in several parts."""
    cure = "; raise points_per_image, mean_track_length or the overlaps."
    num_points = len(tracks.points)
    per_image = np.bincount(tracks.image_index, minlength=num_images)
    if per_image.min() < MIN_POINTS_PER_IMAGE:
        image = int(np.argmin(per_image))
        raise JaxbaError(f"image {image} sees {per_image[image]} points, fewer than {MIN_POINTS_PER_IMAGE}{cure}")
    per_mark = np.bincount(tracks.point_index, minlength=num_points)[: tracks.num_marks]
    if np.any(per_mark < 2):
        raise JaxbaError(f"{np.count_nonzero(per_mark < 2)} control or check points lie in fewer than 2 images{cure}")
    edges = (np.ones(len(tracks.xy_px)), (tracks.image_index, num_images + tracks.point_index))
    parts, _ = connected_components(coo_array(edges, shape=(num_images + num_points,) * 2), directed=False)
    if parts > 1:
        raise JaxbaError(f"the block falls into {parts} parts without common points{cure}")
