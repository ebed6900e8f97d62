"""Statistics of an adjusted block, from those of its last solve: of what was measured, not of priors made up here."""

import numpy as np

from jaxba.ba import Statistics, VarianceComponent
from jaxba.scene import Block, Control, MeasuredKind, Reference, SurveyStatistics
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._measured import used_positions

_DEGREES = {"attitude"}


def survey_statistics(
    adjusted: Adjusted, found: Statistics, reference: Reference, control: Control
) -> SurveyStatistics:
    """Return them; `found`: of the problem as its errors show it."""
    taken = _taken(adjusted, reference, control)
    kinds = tuple(_kind(one, taken[one.name], adjusted) for one in found.components if one.name in taken)
    assumed = [one for one in found.components if one.name not in taken]
    covariance = found.covariance
    single = adjusted.block.camera_parameters.shape[0] == 1
    return SurveyStatistics(
        redundancy=covariance.redundancy,
        kinds=kinds,
        unknowns=tuple(n.removeprefix("camera 0 ") if single else n for n in covariance.border_names),
        unknown_std=np.sqrt(np.maximum(np.diagonal(covariance.border), 0.0)),
        correlation=covariance.correlation,
        assumed_count=sum(one.count for one in assumed),
        assumed_redundancy=float(sum(one.redundancy for one in assumed)),
    )


def _kind(one: VarianceComponent, taken_std: float, adjusted: Adjusted) -> MeasuredKind:
    turn = one.group in _DEGREES
    weighed_std = adjusted.std_px if one.name == "tie points" else _weighed(one, adjusted)
    return MeasuredKind(
        name=one.name,
        unit="px" if one.group == "observations" else "deg" if turn else "m",
        count=one.count,
        redundancy=one.redundancy,
        std=float(np.degrees(one.std)) if turn else one.std,
        std_share=one.factor_std / (2 * one.factor) if one.factor > 0 else float("nan"),
        taken_std=taken_std,
        is_known=one.is_known,
        weighed_std=float(np.degrees(weighed_std)) if turn else weighed_std,
    )


def _weighed(one: VarianceComponent, adjusted: Adjusted) -> float:
    """Return the median sigma of a kind in the last solve; the statistics are of sigmas that its errors show."""
    prior = adjusted.problem.prior(one.group)
    if prior is None or one.group != "position":
        return one.stated_std
    std_m = np.asarray(vars(prior)["std_m"])[:, one.axes]
    return float(np.median(std_m[np.isfinite(std_m)]))


def _taken(adjusted: Adjusted, reference: Reference, control: Control) -> dict[str, float]:
    """Return the kinds that were measured, and the median of the sigmas that they were taken to have, or NaN."""
    nan = float("nan")
    says = control.num_points > 0 and not control.mark_std_is_assumed
    taken = {"tie points": nan, "marks": control.mark_std_px if says else nan}
    if adjusted.block.is_georeferenced:
        taken |= _of_reference(adjusted.block, reference)
    if adjusted.control is not None:
        std_m = control.std_m[adjusted.control.rows]
        taken |= _medians({"control horizontal": std_m[:, :2], "control vertical": std_m[:, 2:]})
    bars = adjusted.problem.prior("scale_bar")
    if bars is not None:
        taken |= _medians({"scale bar": np.asarray(vars(bars)["std_m"])})
    return taken


def _medians(std_m: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the medians of the finite sigmas, where there are any."""
    return {name: float(np.median(std[np.isfinite(std)])) for name, std in std_m.items() if np.isfinite(std).any()}


def _of_reference(block: Block, reference: Reference) -> dict[str, float]:
    index = block.image_index[used_positions(block, reference)]
    std_m = np.where(np.isfinite(reference.xyz_m[index]), reference.std_m[index], np.inf)
    taken = _medians({"position horizontal": std_m[:, :2], "position vertical": std_m[:, 2:]})
    if np.isfinite(reference.quaternion[block.image_index]).all(axis=1).any():
        taken["attitude"] = float("nan")  # what tags state is raised, for errors that all of a flight share
    return taken
