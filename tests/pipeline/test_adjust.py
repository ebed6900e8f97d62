"""The adjust stage: its outputs fit together, and its parameters reach the rounds."""

from dataclasses import fields, replace

import numpy as np
import pytest

from jaxba import sfm
from jaxba.pipeline import adjust
from jaxba.pipeline.adjust import Inputs, Outputs, Params
from jaxba.report import Told
from jaxba.simulation.staged import Simulated, simulate


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    return simulate(10, seed=8, points_per_image=60.0, outlier_fraction=0.05)


@pytest.fixture(scope="module")
def outputs(simulated: Simulated) -> Outputs:
    inputs = Inputs(
        photos=simulated.photos,
        reference=simulated.reference,
        view_graph=simulated.view_graph,
        tracks=simulated.tracks,
        block=simulated.block,
    )
    return adjust.run(inputs, Params(max_rounds=3))


def test_outputs_are_of_one_block(outputs: Outputs, simulated: Simulated) -> None:
    block = outputs.block
    assert outputs.error_px.shape == (block.num_observations,) and np.isfinite(outputs.error_px).all()
    assert outputs.median_px == pytest.approx(float(np.median(outputs.error_px)))
    by_point = [outputs.error_px[block.observation_point == p].mean() for p in range(5)]
    np.testing.assert_allclose(outputs.point_error_px[:5], by_point)
    judged = block.num_observations + outputs.num_rejected
    assert outputs.inlier_rate == pytest.approx(block.num_observations / judged)
    assert judged <= simulated.tracks.num_observations
    assert outputs.rounds <= 3 and 0.5 < outputs.variance_factor < 1.5


@pytest.mark.parametrize("factor", [0.25, 1.0, 4.0, float("nan")])
def test_the_variance_factor_is_told(outputs: Outputs, simulated: Simulated, factor: float) -> None:
    outputs = replace(outputs, variance_factor=factor, std_px=0.5)
    told = Told(photos=tuple(photo.name for photo in simulated.photos))
    line = [line for line in adjust.lines(outputs, told) if "ariance factor" in line]
    found = adjust.facts(outputs, told)["adjust"]
    assert found["std_px"] == 0.5
    if np.isnan(factor):
        assert line == [] and found["variance_factor"] is None
    else:
        times = {0.25: "0.50", 1.0: "1.00", 4.0: "2.00"}[factor]
        assert f"factor {factor:.2f}: residuals scatter by {times} times the 0.50 px" in line[0]
        assert found["variance_factor"] == factor


def test_the_block_is_where_it_was_flown(outputs: Outputs, simulated: Simulated) -> None:
    error = outputs.block.centers_m - np.asarray(simulated.survey.truth.poses.center)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert outputs.num_gnss == 10 and outputs.gnss_rms_m is not None and max(outputs.gnss_rms_m) < 0.12
    np.testing.assert_allclose(outputs.gnss_residual_m, outputs.block.centers_m - simulated.reference.xyz_m, atol=1e-12)
    assert np.isfinite(outputs.position_std_m).all() and np.isfinite(outputs.point_std_m).all()
    assert 0.005 < np.median(outputs.position_std_m) < 0.06  # GNSS of 3 to 6 cm


def test_every_parameter_reaches_the_rounds(simulated: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    class Reached(Exception):
        pass

    def stop(*given: object, **_: object) -> None:
        raise Reached(next(value for value in given if isinstance(value, sfm.Settings)))

    changed = {
        "loss": "cauchy", "f_scale": 2.0, "max_nfev": 123, "ftol": 1e-9, "xtol": 1e-10, "track_threshold": 3.0,
        "mad_factor": 3.5, "max_rounds": 7, "complete_radius": 6.0, "edge_median_limit": 4.0,
    }  # fmt: skip
    assert {field.name for field in fields(Params)} == {*changed, "min_angle"}
    monkeypatch.setattr(sfm, "adjust", stop)
    inputs = Inputs(
        photos=simulated.photos,
        reference=simulated.reference,
        view_graph=simulated.view_graph,
        tracks=simulated.tracks,
        block=simulated.block,
    )
    with pytest.raises(Reached) as reached:
        adjust.run(inputs, Params(**changed, min_angle=3.0))
    settings = vars(reached.value.args[0])
    assert settings == changed | {"min_angle_rad": pytest.approx(np.pi / 60), "held": ()}


def test_parameters_out_of_range_are_refused() -> None:
    from jaxba import JaxbaError

    with pytest.raises(JaxbaError, match="mad_factor=9"):
        Params(mad_factor=9.0)
