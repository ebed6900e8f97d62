"""Accuracy of the product by its check points, as ASPRS's Positional Accuracy Standards state it (edition 2, 2023).

Check points are surveyed, so that what they differ by holds their own errors; the product's accuracy along an axis is

    RMSE = sqrt(fit^2 + survey^2)

with the RMSE of the differences and the sigma of the survey (section 7.5): 1.00 cm of fit with a survey of 2.0 cm is
2.24 cm. Horizontal is east and north together, 3D all three; there is no figure of 95% in that edition. At least 30
check points state it, for up to 500 km2. Against a stated target a survey should be twice as accurate, and a point that
is off by more than three times the target is a blunder: it is named, and to be explained before the product is used.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxba.engine._words import many
from jaxba.scene import Control, ControlFit

LEAST_CHECK_POINTS = 30
_BLUNDER = 3.0  # times the target
_SURVEY = 0.5  # of the target


@dataclass(frozen=True, kw_only=True, eq=False)
class Accuracy:
    """Figures of the check points, metres along local east, north, up; NaN where no point has the axis.

    - `num`: check points along each axis. `fit_m`: RMSE of their differences. `survey_m`: RMS of their sigmas.
    - `product_m`: of both. `target_m`: asked for, horizontal and vertical; NaN where none is.
    - `blunders`: names of points that are off by more than three times the target.
    """

    num: tuple[int, int, int]
    fit_m: Float[np.ndarray, "3"]
    survey_m: Float[np.ndarray, "3"]
    product_m: Float[np.ndarray, "3"]
    target_m: tuple[float, float]
    blunders: tuple[str, ...]

    @property
    def horizontal_m(self) -> float:
        return float(np.hypot(*self.product_m[:2]))

    @property
    def vertical_m(self) -> float:
        return float(self.product_m[2])

    @property
    def is_enough(self) -> bool:
        """Whether there are as many check points as a statement needs, along each axis that has any."""
        return min((num for num in self.num if num), default=0) >= LEAST_CHECK_POINTS

    @property
    def is_survey_fit(self) -> bool | None:
        """Whether the survey is twice as accurate as the target; None without a target."""
        wanted = np.array([*self.target_m]) * _SURVEY
        stated = np.array([float(np.hypot(*self.survey_m[:2])), float(self.survey_m[2])])
        known = np.isfinite(wanted) & np.isfinite(stated)
        return bool((stated[known] <= wanted[known]).all()) if known.any() else None

    @property
    def meets(self) -> bool | None:
        """Whether the product reaches the target; None without a target."""
        reached = np.array([self.horizontal_m, self.vertical_m])
        known = np.isfinite(reached) & np.isfinite(self.target_m)
        return bool((reached[known] <= np.array(self.target_m)[known]).all()) if known.any() else None

    def facts(self) -> dict[str, Any]:
        """Return plain values for `summary.json`."""
        return {
            "standard": "ASPRS 2023, edition 2",
            "check_points": list(self.num),
            "check_points_needed": LEAST_CHECK_POINTS,
            "fit_rmse_m": self.fit_m.tolist(),
            "survey_std_m": self.survey_m.tolist(),
            "product_rmse_m": self.product_m.tolist(),
            "horizontal_rmse_m": self.horizontal_m,
            "vertical_rmse_m": self.vertical_m,
            "three_d_rmse_m": math.hypot(self.horizontal_m, self.vertical_m),
            "target_m": list(self.target_m),
            "meets_target": self.meets,
            "survey_is_twice_as_accurate": self.is_survey_fit,
            "blunders": list(self.blunders),
        }


def accuracy(
    control: Control, fit: ControlFit, target_m: tuple[float, float] = (math.nan, math.nan)
) -> Accuracy | None:
    """Return the accuracy by the check points, `target_m` horizontal and vertical; None without one that compares."""
    known: Bool[np.ndarray, "points 3"] = control.is_check[:, None] & np.isfinite(fit.residual_m)
    if not known.any():
        return None
    off = np.where(known, fit.residual_m, 0.0)
    across, up = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
    is_blunder = (across > _BLUNDER * target_m[0]) | (up > _BLUNDER * target_m[1])  # no target: false
    fit_m, survey_m = _rms(fit.residual_m, known), _rms(control.std_m, known)
    east, north, height = (int(count) for count in known.sum(axis=0))
    return Accuracy(
        num=(east, north, height),
        fit_m=fit_m,
        survey_m=survey_m,
        product_m=np.hypot(fit_m, survey_m),
        target_m=target_m,
        blunders=tuple(name for name, wrong in zip(control.names, is_blunder, strict=True) if wrong),
    )


def accuracy_row(facts: dict[str, Any]) -> str:
    """Return the accuracy in a sentence or two for the terminal, from its facts."""
    parts = [
        f"{word} {value:.3f} m"
        for word, value in (
            ("horizontal", facts["horizontal_rmse_m"]),
            ("vertical", facts["vertical_rmse_m"]),
            ("3D", facts["three_d_rmse_m"]),
        )
        if value is not None and math.isfinite(value)
    ]
    count = min((num for num in facts["check_points"] if num), default=0)
    needed = facts["check_points_needed"]
    texts = [f"RMSE {', '.join(parts)} by {many(count, 'check point')}, survey included ({facts['standard']})"]
    if count < needed:
        texts.append(f"{needed} are needed to state it")
    if facts["meets_target"] is not None:
        texts.append("meets the target" if facts["meets_target"] else "does not meet the target")
    if facts["survey_is_twice_as_accurate"] is False:
        texts.append("the survey is not twice as accurate as the target")
    if facts["blunders"]:
        texts.append(f"off by over three times the target: {', '.join(facts['blunders'])}")
    return "; ".join(texts)


def _rms(values: Float[np.ndarray, "points 3"], known: Bool[np.ndarray, "points 3"]) -> Float[np.ndarray, "3"]:
    total = np.where(known, values, 0.0) ** 2
    count = known.sum(axis=0)
    return np.where(count > 0, np.sqrt(total.sum(axis=0) / np.maximum(count, 1)), np.nan)
