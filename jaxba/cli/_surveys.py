"""Commands that write surveys with known truth: `simulate`, photos of one; `synthetic`, a block of observations."""

from pathlib import Path

import numpy as np

from jaxba.cli._text import many
from jaxba.simulation import Truth, photos

_GNSS_STD_M = (0.03, 0.03, 0.06)


def simulate(
    out: Path,
    *,
    images: int,
    oblique: int,
    width: int,
    height: float,
    forward_overlap: float,
    side_overlap: float,
    gnss_std: tuple[float, float],
    attitude_std: float,
    control: int,
    check: int,
    mark_std: float,
    seed: int,
) -> int:
    """Write the survey and say so; return the exit code.

    `gnss_std` is the noise of positions across and up, metres; the others are the fields of `photos.Params`.
    """
    written = photos.write_survey(
        out,
        photos.Params(
            num_images=images,
            num_oblique=oblique,
            width_px=width,
            height_m=height,
            forward_overlap=forward_overlap,
            side_overlap=side_overlap,
            gnss_std_h_m=gnss_std[0],
            gnss_std_v_m=gnss_std[1],
            attitude_std_deg=attitude_std,
            num_control=control,
            num_check=check,
            mark_std_px=mark_std,
            seed=seed,
        ),
    )
    columns, rows = written.image_size_px
    print(
        f"{written.photos}: {many(written.num_photos, 'photo')} of {columns} x {rows} pixels; "
        f"{many(written.num_control, 'control point')} and {many(written.num_check, 'check point')} beside them; "
        f"{written.num_bytes / 1e6:.0f} MB"
    )
    return 0


def synthetic(
    out: Path,
    *,
    num_images: int,
    seed: int,
    outlier_fraction: float,
    num_cameras: int,
    points_per_image: float,
    pixel_std_px: float,
    num_control: int,
    gnss: bool,
) -> int:
    """Make the survey, write it and say so; return the exit code."""
    from jaxba.io import write_tile  # loads jax, which rendering of photos does on its own
    from jaxba.simulation import uav_block

    survey = uav_block(
        num_images,
        seed=seed,
        outlier_fraction=outlier_fraction,
        num_cameras=num_cameras,
        points_per_image=points_per_image,
        pixel_std_px=pixel_std_px,
        num_control=num_control,
        gnss_std_m=_GNSS_STD_M if gnss else None,
    )
    write_tile(out, survey.problem, extras=_truth_arrays(survey.truth))
    problem = survey.problem
    print(
        f"{out}: {many(problem.num_images, 'image')}, {many(problem.num_points, 'point')}, "
        f"{many(problem.num_observations, 'observation')}, {np.count_nonzero(survey.truth.is_outlier)} of them outliers"
    )
    return 0


def _truth_arrays(truth: Truth) -> dict[str, np.ndarray]:
    """Return the truth as extras of a tile, named like the arrays that they are the truth of."""
    cameras = truth.cameras
    columns = [np.atleast_1d(getattr(cameras, name)) for name in type(cameras).parameter_names()]
    return {
        "truth_pose_quaternion_wxyz": np.asarray(truth.poses.quaternion),
        "truth_pose_translation_m": np.asarray(truth.poses.translation),
        "truth_camera_parameters": np.stack(columns, axis=1),
        "truth_point_xyz_m": truth.points,
        "truth_observation_xy_px": truth.xy_px,
        "truth_lever_arm_m": truth.lever_arm,
        "truth_is_outlier": truth.is_outlier,
        "truth_gnss_is_outlier": truth.gnss_is_outlier,
        "truth_control_index": truth.control_index,
        "truth_check_index": truth.check_index,
    }
