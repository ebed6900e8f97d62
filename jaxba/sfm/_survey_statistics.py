"""Statistics of an adjusted block, from those of its last solve: of what was measured, not of priors made up here."""

import numpy as np

from jaxba.ba import Statistics, VarianceComponent
from jaxba.scene import Block, MeasuredKind, Reference, SurveyStatistics
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._measured import used_positions

_DEGREES = {"attitude"}


def survey_statistics(adjusted: Adjusted, found: Statistics, reference: Reference) -> SurveyStatistics:
    """Return them; `found`: of the problem as its errors show it."""
    stated = _stated(adjusted, reference)
    kinds = tuple(_kind(one, stated[one.name]) for one in found.components if one.name in stated)
    covariance = found.covariance
    single = adjusted.block.camera_parameters.shape[0] == 1
    return SurveyStatistics(
        redundancy=covariance.redundancy,
        kinds=kinds,
        unknowns=tuple(n.removeprefix("camera 0 ") if single else n for n in covariance.border_names),
        unknown_std=np.sqrt(np.maximum(np.diagonal(covariance.border), 0.0)),
        correlation=covariance.correlation,
    )


def _kind(one: VarianceComponent, stated_std: float) -> MeasuredKind:
    turn = one.group in _DEGREES
    return MeasuredKind(
        name=one.name,
        unit="px" if one.group == "observations" else "deg" if turn else "m",
        count=one.count,
        redundancy=one.redundancy,
        std=float(np.degrees(one.std)) if turn else one.std,
        std_share=one.factor_std / (2 * one.factor) if one.factor > 0 else float("nan"),
        stated_std=stated_std,
        is_known=one.is_known,
    )


def _stated(adjusted: Adjusted, reference: Reference) -> dict[str, float]:
    """Return the kinds that were measured, and the median of the sigmas that are stated; NaN where none are."""
    block, nan = adjusted.block, float("nan")
    stated = {"tie points": nan, "marks": nan}
    if block.is_georeferenced:
        stated |= _of_reference(block, reference)
    if adjusted.control is not None:
        std_m = np.where(np.isfinite(adjusted.control.std_m), adjusted.control.std_m, np.nan)
        for name, axes in (("control horizontal", slice(0, 2)), ("control vertical", slice(2, 3))):
            known = std_m[:, axes][np.isfinite(std_m[:, axes])]
            if len(known):
                stated[name] = float(np.median(known))
    bars = adjusted.problem.prior("scale_bar")
    if bars is not None:
        stated["scale bar"] = float(np.median(vars(bars)["std_m"]))
    return stated


def _of_reference(block: Block, reference: Reference) -> dict[str, float]:
    index = block.image_index[used_positions(block, reference)]
    std_m = np.where(np.isfinite(reference.xyz_m[index]), reference.std_m[index], np.nan)
    stated = {}
    for name, axes in (("position horizontal", slice(0, 2)), ("position vertical", slice(2, 3))):
        known = std_m[:, axes][np.isfinite(std_m[:, axes])]
        if len(known):
            stated[name] = float(np.median(known))
    if np.isfinite(reference.quaternion[block.image_index]).all(axis=1).any():
        stated["attitude"] = float("nan")  # what tags state is raised, for errors that all of a flight share
    return stated
