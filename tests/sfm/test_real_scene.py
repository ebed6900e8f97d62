"""Start values of a real scene that is no aerial block equal COLMAP's: 12 photos of a door, from the images alone.

The model's features and tracks are measured ones; relative poses are estimated here from the features that two photos
share, as the stages before would, with a focal length 3% off.
"""

import dataclasses
from pathlib import Path

import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation
from surveys import FRAME

from jaxba.scene import EdgeStatus, Photo, Reference, Tracks, ViewGraph
from jaxba.sfm import initialise

FOCAL_PX, WIDTH_PX, HEIGHT_PX = 2500.0, 1296, 1936  # COLMAP's is 2435


@dataclasses.dataclass(frozen=True)
class Door:
    photos: tuple[Photo, ...]
    view_graph: ViewGraph
    tracks: Tracks
    rotations: np.ndarray
    centers: np.ndarray


@pytest.fixture(scope="module")
def door(data_dir: Path) -> Door:
    text = (data_dir / "colmap" / "lund_door" / "images.txt").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    heads = [line.split() for line in lines[::2]]
    pose = np.array([[float(v) for v in head[1:8]] for head in heads])
    rows = [np.array(line.split(), float).reshape(-1, 3) for line in lines[1::2]]
    names = [head[9] for head in heads]
    order = np.argsort(names)
    pose, rows = pose[order], [rows[k][np.unique(rows[k][:, 2], return_index=True)[1]] for k in order]
    rows = [part[part[:, 2] >= 0] for part in rows]
    every, image = np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(part) for part in rows])
    _, track = np.unique(every[:, 2], return_inverse=True)
    sort = np.lexsort((image, track))
    tracks = Tracks(
        track_index=track[sort],
        image_index=image[sort],
        feature_index=np.arange(len(sort)),
        xy_px=every[sort, :2],
        rgb=np.zeros((track.max() + 1, 3), np.uint8),
        components=(tuple(range(len(rows))),),
    )
    photos = tuple(
        Photo(
            name=names[k], path=Path(names[k]), sha256=names[k], width_px=WIDTH_PX, height_px=HEIGHT_PX, camera="c",
            focal_px=FOCAL_PX,
        )
        for k in order
    )  # fmt: skip
    rotations = Rotation.from_quat(pose[:, :4], scalar_first=True).as_matrix()
    centers = -np.einsum("nji,nj->ni", rotations, pose[:, 4:])
    return Door(photos, view_graph(tracks, len(rows)), tracks, rotations, centers)


def view_graph(tracks: Tracks, num_images: int) -> ViewGraph:
    camera = {
        "model": "SIMPLE_PINHOLE", "width": WIDTH_PX, "height": HEIGHT_PX,
        "params": [FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2],
    }  # fmt: skip
    place = np.full((num_images, tracks.num_tracks), -1)
    place[tracks.image_index, tracks.track_index] = np.arange(tracks.num_observations)
    pairs, count, quaternion, direction = [], [], [], []
    for i in range(num_images):
        for j in range(i + 1, num_images):
            both = (place[i] >= 0) & (place[j] >= 0)
            if both.sum() < 300:
                continue
            some = np.flatnonzero(both)[:: both.sum() // 300]
            xy = [tracks.xy_px[place[k][some]] for k in (i, j)]
            found, _ = poselib.estimate_relative_pose(*xy, camera, camera, {"max_epipolar_error": 2.0, "seed": 0}, {})
            pairs.append((i, j))
            count.append(both.sum())
            quaternion.append(found.q)
            direction.append(found.t / np.linalg.norm(found.t))
    size = len(pairs)
    return ViewGraph(
        pairs=np.array(pairs, np.int32),
        status=np.full(size, EdgeStatus.GOOD, np.uint8),
        offsets=np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
        matches=np.zeros((sum(count), 2), np.int32),
        num_putative=np.array(count, np.int32),
        is_planar=np.zeros(size, bool),
        quaternion=np.array(quaternion),
        direction=np.array(direction),
        residual_px=np.full(size, 0.5),
        distinctiveness=np.full(size, 0.5),
        angle_rad=np.full(size, 0.2),
    )


def test_poses_from_the_images_alone_equal_colmaps(door: Door) -> None:
    nothing = np.full((12, 3), np.nan)
    reference = Reference(
        frame=None, xyz_m=nothing, std_m=nothing, quaternion=np.full((12, 4), np.nan), attitude_std_rad=nothing,
        is_used=np.zeros(12, bool), height_above_ground_m=np.full(12, np.nan),
    )  # fmt: skip
    block = initialise(
        door.photos, reference, door.view_graph, door.tracks, camera_model="SIMPLE_RADIAL", min_angle_rad=0.026
    )
    assert block.num_images == 12 and not block.unregistered
    assert block.num_observations > 0.95 * door.tracks.num_observations
    relative = Rotation.from_quat(block.quaternion, scalar_first=True).inv() * Rotation.from_matrix(door.rotations)
    assert (relative * relative.mean().inv()).magnitude().max() < 0.003
    a, b = (c - c.mean(axis=0) for c in (relative.mean().inv().apply(block.centers_m), door.centers))
    scale = (a * b).sum() / (a * a).sum()
    # 0.3% of the extent, and the focal length within 0.5%: the rough adjustment leaves out what COLMAP refines last
    assert np.linalg.norm(scale * a - b, axis=1).max() < 0.003 * np.ptp(b, axis=0).max()
    assert abs(block.camera_parameters[0, 0] / 2435.38 - 1) < 0.005


def test_positions_place_a_scene_that_is_not_seen_from_above(door: Door) -> None:
    # the model's y points down: east, north, up are x, z and -y; every view is level, and no attitude says so
    enu = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    centers = door.centers @ enu.T
    xyz_m = centers + 0.02 * np.random.default_rng(0).normal(size=(12, 3))
    reference = Reference(
        frame=FRAME, xyz_m=xyz_m, std_m=np.full((12, 3), 0.02), quaternion=np.full((12, 4), np.nan),
        attitude_std_rad=np.full((12, 3), np.nan), is_used=np.ones(12, bool),
        height_above_ground_m=np.full(12, np.nan),
    )  # fmt: skip
    block = initialise(
        door.photos, reference, door.view_graph, door.tracks, camera_model="SIMPLE_RADIAL", min_angle_rad=0.026
    )
    assert block.is_georeferenced
    assert np.linalg.norm(block.centers_m - centers, axis=1).max() < 0.08  # sigma 0.02 an axis on 12 positions
