"""What a report is made of: the records of a project's stages, and what several sections need of them."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.engine._parameters import Parameters
from jaxba.report._recorded import Recorded
from jaxba.scene import Block, LocalFrame, Photo, Reference, Tracks

NOT_ADJUSTED = "The block has not been adjusted."


@dataclass(frozen=True)
class Material:
    """The records of a project.

    - `folder`: of the project. `summary`: of its last run, as `summary.json` has it; empty before one has ended.
    - `settings`, `defaults`: parameters by section. `seconds`: that each stage took when it last had anything to do.
    """

    folder: Path
    found: Recorded
    summary: Mapping[str, Any]
    settings: Mapping[str, Parameters]
    defaults: Mapping[str, Parameters]
    seconds: Mapping[str, float]

    @property
    def done(self) -> Any:
        return self.found.done

    @property
    def adjusted(self) -> Any:
        """What the adjustment made; None before it."""
        return self.done.adjust

    @property
    def block(self) -> Block | None:
        """The block as far as it is known: adjusted, else its start values, else None."""
        if self.adjusted is not None:
            return self.adjusted.block
        return None if self.done.start is None else self.done.start.block

    @property
    def photos(self) -> tuple[Photo, ...]:
        return self.done.photos

    @property
    def reference(self) -> Reference | None:
        """Measured positions; None before they were read."""
        if self.done.control is not None:
            return self.done.control.reference
        return None if self.done.crs is None else self.done.crs.reference

    @property
    def frame(self) -> LocalFrame | None:
        """The frame of a block that has a place on earth, or of the positions before there is a block; else None."""
        if self.reference is None or (self.block is not None and not self.block.is_georeferenced):
            return None
        return self.reference.frame

    @property
    def let_go(self) -> set[str]:
        """Names of the photos whose measured position contradicts the block, so that it hardly counts."""
        found = [finding for finding in self.found.findings if finding.kind == "positions contradict"]
        return {name for finding in found for name in finding.figures["names"]}

    def in_crs(self, xyz_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return places of the local frame in the target CRS; as they are where there is none."""
        from jaxba import geo

        return np.asarray(xyz_m, float) if self.frame is None else geo.projected_from_local(self.frame, xyz_m)

    def mapped(self, xyz_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points of the block in the target CRS, as `control.method=affine` maps them before."""
        affine = np.eye(3, 4) if self.adjusted is None else self.adjusted.affine
        return self.in_crs(np.asarray(xyz_m) @ affine[:, :3].T + affine[:, 3])

    @functools.cached_property
    def errors(self) -> "Errors | None":
        """Errors of all observations of the block's points, also of those left out; None before the adjustment."""
        return None if self.adjusted is None else _errors(self.adjusted.block, self.done.tracks.tracks)


def gsd_m(material: Material) -> float:
    """Return the median ground sample distance of the adjusted photos, metres a pixel; NaN where it is not known."""
    adjusted = material.adjusted
    if adjusted is None or not adjusted.block.is_georeferenced:
        return np.nan
    from jaxba.sfm import height_above_ground

    block = adjusted.block
    return float(np.nanmedian(height_above_ground(block) / block.camera_parameters[block.camera_index, 0]))


@dataclass(frozen=True, eq=False)
class Errors:
    """Observations of the adjusted points in the adjusted images, by tracks, and what became of them.

    - `image`: row of the block. `xy_px`: measured. `off_px`: projected minus measured; NaN without a projection.
    - `is_used`: the observation is one of the adjustment.
    """

    image: Int[np.ndarray, " rows"]
    xy_px: Float[np.ndarray, "rows 2"]
    off_px: Float[np.ndarray, "rows 2"]
    is_used: Bool[np.ndarray, " rows"]

    @property
    def length_px(self) -> Float[np.ndarray, " rows"]:
        return np.hypot(*self.off_px.T)


def _errors(block: Block, tracks: Tracks) -> Errors:
    """Return the observations of the block, and those of its points' tracks that are not in it.

    The adjustment splits and joins tracks: a track is that of the point to which most of its observations went.
    """
    import pandas as pd

    keys = ["image", "x", "y"]
    row_of_image = np.full(int(max(tracks.image_index.max(initial=0), block.image_index.max(initial=0))) + 1, -1)
    row_of_image[block.image_index] = np.arange(block.num_images)
    given = pd.DataFrame({"track": tracks.track_index, "image": row_of_image[tracks.image_index]})
    given[["x", "y"]] = tracks.xy_px
    used = pd.DataFrame({"point": block.observation_point, "image": block.observation_image})
    used[["x", "y"]] = block.observation_xy_px
    both: Any = given[given["image"] >= 0].merge(used, "left", keys)
    counts = both.dropna(subset="point").groupby(["track", "point"]).size().reset_index(name="count")
    points = counts.sort_values(["count", "track", "point"], ascending=[False, True, True]).drop_duplicates("track")
    left = both[both["point"].isna()][["track", *keys]].merge(points[["track", "point"]], on="track")
    image = np.concatenate([block.observation_image, left["image"].to_numpy(np.int64)])
    point = np.concatenate([block.observation_point, left["point"].to_numpy(np.int64)])
    xy_px = np.concatenate([block.observation_xy_px, left[["x", "y"]].to_numpy()])
    is_used = np.arange(len(image)) < block.num_observations
    return Errors(image, xy_px, projected(block, image, block.points_m[point]) - xy_px, is_used)


def projected(
    block: Block, image: Int[np.ndarray, " rows"], points_m: Float[np.ndarray, "rows 3"]
) -> Float[np.ndarray, "rows 2"]:
    """Return the pixels of points, each in one image of a block; NaN behind the camera and where the lens has none."""
    from scipy.spatial.transform import Rotation

    from jaxba.ba import project_in_cameras
    from jaxba.geometry import CAMERAS

    rotation = Rotation.from_quat(block.quaternion, scalar_first=True).as_matrix()
    point = np.einsum("nij,nj->ni", rotation[image], points_m) + block.translation_m[image]
    cameras = CAMERAS[block.camera_model].from_parameters(block.camera_parameters)
    with np.errstate(all="ignore"):
        xy_px = project_in_cameras(cameras, block.camera_index[image], point.T).T
    return np.where((point[:, 2:] > 0) & np.isfinite(xy_px), xy_px, np.nan)
