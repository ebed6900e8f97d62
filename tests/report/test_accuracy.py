"""Accuracy of a product by its check points, against figures worked out by hand from ASPRS's standard."""

import math
from dataclasses import replace

import numpy as np
import pytest

from jaxba.report import accuracy, accuracy_row
from jaxba.scene import Control, ControlFit


def given(residual_m: np.ndarray, std_m: np.ndarray) -> tuple[Control, ControlFit]:
    """As many check points, and a control point that is off by metres and does not count."""
    count = len(residual_m)
    control = replace(
        Control.nothing(),
        names=tuple(f"c{k}" for k in range(count + 1)),
        xyz_m=np.zeros((count + 1, 3)),
        std_m=np.concatenate([std_m, np.ones((1, 3))]),
        is_check=np.arange(count + 1) < count,
    )
    fit = replace(ControlFit.nothing(count + 1), residual_m=np.concatenate([residual_m, np.full((1, 3), 5.0)]))
    return control, fit


def test_the_survey_is_part_of_the_accuracy() -> None:
    """1.00 cm of fit and a survey of 2.0 cm: 2.24 cm."""
    signs = np.where(np.arange(30) % 2, 1.0, -1.0)[:, None] * np.ones(3)
    found = accuracy(*given(0.01 * signs, np.full((30, 3), 0.02)))
    assert found is not None and found.is_enough and found.meets is None and found.blunders == ()
    np.testing.assert_allclose(found.product_m, 0.0223607, atol=1e-6)
    assert found.horizontal_m == pytest.approx(0.0223607 * math.sqrt(2), abs=1e-6)
    facts = found.facts()
    assert facts["three_d_rmse_m"] == pytest.approx(0.0223607 * math.sqrt(3), abs=1e-6)
    assert accuracy_row(facts).startswith("RMSE horizontal 0.032 m, vertical 0.022 m, 3D 0.039 m by 30 check points")
    assert "needed" not in accuracy_row(facts) and "target" not in accuracy_row(facts)


def test_few_points_a_rough_survey_and_blunders_are_told() -> None:
    off = np.full((5, 3), 0.03)
    off[2, 2] = -0.4
    found = accuracy(*given(off, np.full((5, 3), 0.04)), (0.10, 0.08))
    assert found is not None and not found.is_enough
    assert found.meets is False and found.is_survey_fit is False and found.blunders == ("c2",)
    told = accuracy_row(found.facts())
    assert "30 are needed to state it; does not meet the target" in told
    assert "not twice as accurate" in told and told.endswith("off by over three times the target: c2")
    met = accuracy(*given(np.full((30, 3), 0.03), np.full((30, 3), 0.01)), (0.10, math.nan))
    assert met is not None and met.meets and met.is_survey_fit and "meets the target" in accuracy_row(met.facts())


def test_an_axis_that_no_check_point_has_does_not_count() -> None:
    off = np.full((30, 3), 0.03)
    off[:, 2] = np.nan
    found = accuracy(*given(off, np.where([True, True, False], 0.02, np.inf) * np.ones((30, 3))))
    assert found is not None and found.num == (30, 30, 0) and found.is_enough and math.isnan(found.vertical_m)
    assert "vertical" not in accuracy_row(found.facts())
    assert accuracy(*given(np.full((2, 3), np.nan), np.ones((2, 3)))) is None
