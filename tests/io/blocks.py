"""A small flown block in numpy alone, with its reprojection errors by the published formulas of the camera models."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxba.io import Cloud
from jaxba.scene import Block, LeftOut, Photo

MODELS = {
    "SIMPLE_PINHOLE": (900.0, 601.5, 448.0),
    "PINHOLE": (900.0, 903.0, 601.5, 448.0),
    "SIMPLE_RADIAL": (900.0, 601.5, 448.0, -0.05),
    "RADIAL": (900.0, 601.5, 448.0, -0.05, 0.01),
    "OPENCV": (900.0, 903.0, 601.5, 448.0, -0.05, 0.01, 1e-3, -2e-3, 0.0),
    "OPENCV with k3": (900.0, 903.0, 601.5, 448.0, -0.05, 0.01, 1e-3, -2e-3, 4e-3),
    "OPENCV_FISHEYE": (900.0, 903.0, 601.5, 448.0, -0.05, 0.01, 1e-3, -2e-3),
}
SIZE_PX = (1200, 900)


@dataclass(frozen=True)
class Flown:
    """- `error_px`: of each observation, `point_error_px`: mean of each point."""

    block: Block
    photos: tuple[Photo, ...]
    error_px: np.ndarray
    point_error_px: np.ndarray

    @property
    def registered(self) -> list[Photo]:
        return [self.photos[i] for i in self.block.image_index]


def flown_block(model: str = "OPENCV with k3", *, num_points: int = 400, seed: int = 0) -> Flown:
    """Return 8 photos by two cameras, 6 of them registered, over a hilly square of 100 m, in local coordinates."""
    rng = np.random.default_rng(seed)
    index = np.array([0, 1, 2, 4, 5, 7])
    names = [f"DJI_{i:04d}.JPG" for i in range(8)]
    names[2] = "line 2/späte Aufnahme.JPG"
    photos = tuple(
        Photo(name=name, path=Path(name), sha256="", width_px=SIZE_PX[0], height_px=SIZE_PX[1],
              camera="left" if i < 4 else "right", time=f"2024-05-01T10:00:{59 - 7 * i:02d}")
        for i, name in enumerate(names)
    )  # fmt: skip
    centers = np.stack([20.0 * (index % 4) + rng.normal(size=6), 30.0 * (index // 4) + 20, 60 + rng.normal(size=6)], 1)
    tilt = Rotation.from_euler("xyz", rng.normal(0, 8, (6, 3)), degrees=True)
    rotation = (
        tilt * Rotation.from_euler("z", 90.0 * (index[:, None] // 4), degrees=True) * Rotation.from_euler("x", np.pi)
    )
    parameters = np.array([MODELS[model], MODELS[model]])
    parameters[1] *= 1.001
    points = np.stack(
        [rng.uniform(-20, 90, num_points), rng.uniform(0, 80, num_points), rng.normal(0, 3, num_points)], 1
    )
    image, point = (grid.ravel() for grid in np.meshgrid(np.arange(6), np.arange(num_points), indexing="ij"))
    translation = -rotation.apply(centers)
    camera_index = (index >= 4).astype(np.int64)
    xy = project(model, parameters[camera_index[image]], rotation[image].apply(points[point]) + translation[image])
    inside = np.all((xy > 0) & (xy < SIZE_PX), axis=1)
    many = np.bincount(point[inside], minlength=num_points) >= 2
    keep = inside & many[point]
    number = np.cumsum(many) - 1
    shuffle = rng.permutation(int(keep.sum()))
    image, point, xy = image[keep][shuffle], number[point[keep]][shuffle], xy[keep][shuffle]
    noise = rng.normal(0, 0.4, xy.shape)
    error = np.linalg.norm(noise, axis=1)
    count = int(many.sum())
    block = Block(
        image_index=index, quaternion=rotation.as_quat(scalar_first=True), translation_m=translation,
        camera_model=model.split()[0], camera_names=("left", "right"), camera_parameters=parameters,
        camera_index=camera_index, points_m=points[many], track_index=np.arange(count),
        rgb=rng.integers(0, 256, (count, 3)).astype(np.uint8), observation_image=image, observation_point=point,
        observation_xy_px=xy + noise, is_georeferenced=True,
        unregistered=(LeftOut(name=names[3], reason="too few matches"), LeftOut(name=names[6], reason="blurred")),
    )  # fmt: skip
    mean = np.bincount(point, error, minlength=count) / np.bincount(point, minlength=count)
    return Flown(block, photos, error, mean)


def flown_cloud(offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Cloud:
    """Return the cloud of the block, moved."""
    flown = flown_block()
    block = flown.block
    return Cloud(
        xyz=block.points_m + np.array(offset),
        rgb=block.rgb,
        point_id=np.arange(1, block.num_points + 1),
        track_length=np.bincount(block.observation_point),
        error_px=flown.point_error_px,
        std_m=np.full((block.num_points, 3), np.nan),
    )


def project(model: str, parameters: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return pixels by the formulas of COLMAP (sensor/models.h) and OpenCV (calib3d, fisheye), in numpy."""
    p = parameters.T
    u, v = point[:, 0] / point[:, 2], point[:, 1] / point[:, 2]
    r2 = u * u + v * v
    if model == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        scale = theta * (1 + p[4] * theta**2 + p[5] * theta**4 + p[6] * theta**6 + p[7] * theta**8) / r
        return np.stack([p[0] * scale * u + p[2], p[1] * scale * v + p[3]], axis=1)
    if model.startswith("OPENCV"):
        radial = 1 + p[4] * r2 + p[5] * r2**2 + p[8] * r2**3
        du = 2 * p[6] * u * v + p[7] * (r2 + 2 * u * u)
        dv = p[6] * (r2 + 2 * v * v) + 2 * p[7] * u * v
        return np.stack([p[0] * (u * radial + du) + p[2], p[1] * (v * radial + dv) + p[3]], axis=1)
    if model == "PINHOLE":
        return np.stack([p[0] * u + p[2], p[1] * v + p[3]], axis=1)
    radial = 1.0 + (p[3] * r2 if len(p) > 3 else 0) + (p[4] * r2**2 if len(p) > 4 else 0)
    return np.stack([p[0] * radial * u + p[1], p[0] * radial * v + p[2]], axis=1)
