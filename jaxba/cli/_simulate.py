"""`jaxba simulate`: a small survey with known truth, to try the pipeline on."""

from pathlib import Path

from jaxba.cli._text import many
from jaxba.simulation.photos import Params, write_survey


def run(
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

    `gnss_std` is the noise of positions across and up, metres; the others are the fields of `Params`.
    """
    written = write_survey(
        out,
        Params(
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
