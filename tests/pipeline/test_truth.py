"""One whole run on a simulated survey agrees with the truth that it has not seen, within its own predicted sigmas.

The run is the one that the tests share; the limits are those of `python -m benchmarks.truth` on larger surveys, where
they hold for several seeds.
"""

import numpy as np
import pytest
from small_survey import NUM_PHOTOS, Survey

from benchmarks.truth import Figure, compare, markdown


@pytest.fixture(scope="module")
def figures(made: Survey) -> dict[str, Figure]:
    found = compare(made.photos.parent, made.project)
    print(markdown(found))
    return {figure.name: figure for figure in found}


def test_positions_and_points_lie_within_three_sigma(figures: dict[str, Figure]) -> None:
    position, point = figures["positions"], figures["points"]
    assert position.error.shape == (NUM_PHOTOS, 3) and np.abs(position.over_sigma).max() < 3
    assert position.rms < 0.06  # of GNSS with 3 and 5 cm
    assert point.error.size > 2000 and point.share_within > 0.985 and point.rms_over_sigma < 1.5
    assert abs(np.median(point.error)) < 0.05
    assert figures["points, 3 to 5 views"].share_within > 0.985  # 98.3 to 99.2% in ten larger surveys


def test_the_camera_lies_within_three_sigma(figures: dict[str, Figure]) -> None:
    assert np.abs(figures["focal length"].over_sigma).max() < 3
    assert np.abs(figures["focal length"].error).max() < 1.0  # its data sheet is 5 px off
    for name in ("principal point", "distortion"):
        assert np.abs(figures[name].over_sigma).max() < 4  # the largest of several
    assert figures["rays"].rms < 0.1


def test_targets_are_where_they_were_surveyed(figures: dict[str, Figure]) -> None:
    for name in ("control points", "check points"):
        target = figures[name]
        assert target.error.shape == (5, 3) and np.abs(target.over_sigma).max() < 3.5 and target.rms < 0.1
