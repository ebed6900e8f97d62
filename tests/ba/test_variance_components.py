"""Variance components: planted sigmas come back, kind by kind; the global test; tables of all of it."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxba
from jaxba import Huber, JaxbaError, Statistics
from jaxba.ba import Problem
from jaxba.geometry import AbstractLoss, Linear

PIXEL_STD_PX, GNSS_STD_M, CONTROL_STD_M = 0.3, (0.02, 0.02, 0.05), (0.01, 0.01, 0.01)


def wrongly_weighed(outlier_fraction: float) -> Problem:
    """A block whose sigmas are stated as 1 px, 3 and 5 m, and 3 cm."""
    survey = jaxba.synthetic.uav_block(
        20, seed=3, points_per_image=30.0, num_control=24, pixel_std_px=PIXEL_STD_PX, gnss_std_m=GNSS_STD_M,
        control_std_m=CONTROL_STD_M, outlier_fraction=outlier_fraction,
    )  # fmt: skip
    problem = survey.problem
    stated = {"position": (3.0, 3.0, 5.0), "control": (0.03, 0.03, 0.03)}
    priors = tuple(
        dataclasses.replace(prior, std_m=np.tile(stated[prior.name], (len(prior.std_m), 1))) for prior in problem.priors
    )
    observations = dataclasses.replace(problem.observations, std_px=np.ones(problem.num_observations))
    return dataclasses.replace(problem, observations=observations, priors=priors)


def statistics_of(problem: Problem, loss: AbstractLoss) -> Statistics:
    return jaxba.statistics(jaxba.solve(problem, loss=loss).apply(problem), loss=loss)


@pytest.mark.parametrize(("loss", "outliers"), [(Linear(), 0.0), (Huber(1.0), 0.02)], ids=["linear", "huber"])
def test_planted_sigmas_come_back(loss: AbstractLoss, outliers: float) -> None:
    problem = wrongly_weighed(outliers)
    found = statistics_of(problem, loss)
    for _ in range(4):
        problem = found.reweighted(1e3)
        found = statistics_of(problem, loss)
    std = {component.name: component.std for component in found.components}
    planted = {
        "tie points": PIXEL_STD_PX, "marks": PIXEL_STD_PX, "position horizontal": GNSS_STD_M[0],
        "position vertical": GNSS_STD_M[2], "control horizontal": CONTROL_STD_M[0],
    }  # fmt: skip
    for component in found.components:
        assert component.is_known, component
        # settled, and right within three of its own sigmas, of some 1% to 25%; 2% of gross errors add 5 to 7%
        assert component.factor == pytest.approx(1.0, abs=0.1), component.name
        if component.name in planted:
            allowed = max(3 / np.sqrt(2 * component.redundancy), 4 * outliers)
            assert std[component.name] == pytest.approx(planted[component.name], rel=allowed), component


def test_kinds_without_redundancy_keep_their_sigmas_and_say_so() -> None:
    problem = jaxba.synthetic.uav_block(20, seed=3, points_per_image=30.0, num_control=2).problem
    found = statistics_of(problem, Linear())
    control = [component for component in found.components if component.group == "control"]
    assert len(control) == 2 and not any(component.is_known for component in control)
    priors = {prior.name: prior for prior in found.reweighted().priors}
    np.testing.assert_array_equal(priors["control"].std_m, problem.prior("control").std_m)  # type: ignore[union-attr]
    assert (priors["position"].std_m != problem.prior("position").std_m).all()  # type: ignore[union-attr]
    with pytest.raises(JaxbaError, match="most"):
        found.reweighted(0.5)


def test_global_test_tells_true_sigmas_from_small_ones() -> None:
    problem = jaxba.synthetic.uav_block(20, seed=3, points_per_image=30.0).problem
    right = statistics_of(problem, Linear())
    assert 0.005 < right.p_value < 0.995
    small = dataclasses.replace(problem.observations, std_px=0.9 * problem.observations.std_px)
    assert statistics_of(dataclasses.replace(problem, observations=small), Linear()).p_value < 1e-6
    assert np.isnan(statistics_of(problem, Huber(1.0)).p_value)  # squares under a robust loss follow no known law


def test_tables_hold_a_row_for_each_measurement() -> None:
    problem = jaxba.synthetic.uav_block(20, seed=3, points_per_image=30.0, num_control=14).problem
    found = statistics_of(problem, Linear())
    seen = found.observations_frame()
    assert len(seen) == problem.num_observations and seen["residual_x_px"].notna().all()
    np.testing.assert_array_equal(seen["point"], problem.observations.point_index)
    np.testing.assert_array_equal(seen["test_y"], found.observations.test[:, 1])
    control = found.prior_frame("control")
    assert control["point"].tolist() == list(range(14)) and {"detectable_z_m", "reach_x_m"} <= set(control.columns)
    assert found.components_frame().set_index("name").loc["marks", "count"] > 28
    total = seen[["redundancy_x", "redundancy_y"]].to_numpy().sum() + sum(
        found.prior_frame(name).filter(like="redundancy").to_numpy().sum() for name in ("position", "control")
    )
    assert total == pytest.approx(found.covariance.redundancy, abs=1e-6)
    points, images, cameras = found.points_frame(), found.images_frame(), found.cameras_frame()
    np.testing.assert_array_equal(points["std_z_m"], np.sqrt(found.covariance.points[:, 2, 2]))
    assert points["num_observations"].sum() == images["num_observations"].sum() == problem.num_observations
    rotation = Rotation.from_quat(found.problem.poses.quaternion, scalar_first=True)
    centers = -rotation.inv().apply(found.problem.poses.translation)  # in double precision
    np.testing.assert_allclose(images["x_m"], centers[:, 0], rtol=1e-12)
    np.testing.assert_array_equal(images["std_rot_z_rad"], np.sqrt(found.covariance.poses[:, 2, 2]))
    pairs = found.pairs_frame()
    sees = np.zeros((problem.num_images, problem.num_points), int)
    sees[problem.observations.image_index, problem.observations.point_index] = 1
    common = sees @ sees.T
    assert [tuple(row) for row in pairs[["image_1", "image_2"]].to_numpy()] == list(
        zip(*np.nonzero(np.triu(common, 1)), strict=True)
    )
    np.testing.assert_array_equal(pairs["num_points"], common[pairs["image_1"], pairs["image_2"]])
    one, other = pairs["image_1"][5], pairs["image_2"][5]
    shared = np.flatnonzero(sees[one] & sees[other])
    sides = [np.linalg.norm(found.problem.points[shared] - centers[k], axis=1) for k in (one, other)]
    base = np.linalg.norm(centers[one] - centers[other])
    angles = np.arccos((sides[0] ** 2 + sides[1] ** 2 - base**2) / (2 * sides[0] * sides[1]))
    assert pairs["angle_deg"][5] == pytest.approx(np.degrees(np.median(angles)), rel=1e-9)
    assert pairs["distance_m"][5] == pytest.approx(base, rel=1e-12)
    focal = cameras.set_index("parameter").loc["fx"]
    assert focal["value"] == np.ravel(found.problem.cameras.fx)[0] and focal["std"] > 0  # type: ignore[attr-defined]
    # the ellipse gives back the covariance that it is of
    a, b, azimuth = images[["ellipse_a_m", "ellipse_b_m", "ellipse_azimuth_deg"]].to_numpy().T
    along = np.stack([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))], axis=1)
    across = along[:, ::-1] * [1, -1]
    again = np.einsum("n,ni,nj->nij", a**2, along, along) + np.einsum("n,ni,nj->nij", b**2, across, across)
    np.testing.assert_allclose(again, found.covariance.centers[:, :2, :2], rtol=1e-6, atol=1e-12)
    # those of the solution alone are the same, without what needs sigmas
    solution = jaxba.solve(problem)
    alike = {"observations": seen, "images": images, "points": points, "control": control, "pairs": pairs}
    for name, table in alike.items():
        alone = getattr(solution, f"{name}_frame")()
        columns = [column for column in table.columns if column in alone.columns]
        assert len(columns) == len(alone.columns) and len(alone) == len(table), name
        numbers = table[columns].to_numpy(float), alone.to_numpy(float)
        np.testing.assert_allclose(*numbers, rtol=1e-6, atol=1e-6, err_msg=name)
    with pytest.raises(JaxbaError, match=r"images_frame: a solution from inside jit"):
        dataclasses.replace(solution, report=None).images_frame()
    with pytest.raises(JaxbaError, match="no prior 'attitude'; it has position, control"):
        found.prior_frame("attitude")


def test_weights_are_estimated_in_the_adjustment_that_uses_them() -> None:
    problem = wrongly_weighed(0.0)
    found = jaxba.solve_and_reweight(problem, most=1e3)
    assert found.is_settled and not found.at_limit and len(found.solutions) > 2
    stated = problem.prior("position").std_m  # type: ignore[union-attr]
    estimated = found.problem.prior("position").std_m  # type: ignore[union-attr]
    np.testing.assert_allclose(estimated[:, 2] / stated[:, 2], found.times["position vertical"], rtol=1e-12)
    position = next(c for c in found.statistics.components if c.name == "position vertical")
    assert position.std == pytest.approx(GNSS_STD_M[2], rel=3 / np.sqrt(2 * position.redundancy))
    assert found.times["tie points"] * problem.observations.std_px[0] == pytest.approx(PIXEL_STD_PX, rel=0.05)
    held = jaxba.solve_and_reweight(problem, most=1.2, rounds=3)
    assert "position vertical" in held.at_limit
    assert all(1 / 1.2 - 1e-9 < times < 1.2 + 1e-9 for times in held.times.values())


def test_components_by_label_tell_two_cameras_and_two_flights_apart() -> None:
    problem = jaxba.synthetic.uav_block(20, seed=3, points_per_image=30.0, num_control=14).problem
    image = problem.observations.image_index
    camera, flight = np.arange(20) % 2, np.where(np.arange(20) < 10, "first", "second")
    std_px = np.where(camera[image] == 0, problem.observations.std_px, problem.observations.std_px / 2)
    position = problem.prior("position")
    std_m = np.where(flight[position.image_index][:, None] == "first", 1.0, 0.5) * position.std_m  # type: ignore[union-attr]
    priors = tuple(dataclasses.replace(p, std_m=std_m) if p is position else p for p in problem.priors)  # type: ignore[call-arg]
    observations = dataclasses.replace(problem.observations, std_px=std_px)
    wrong = dataclasses.replace(problem, observations=observations, priors=priors)
    found = statistics_of(wrong, Linear())
    by_camera = found.components_by(camera[image])
    by_flight = found.components_by(flight[position.image_index], "position")  # type: ignore[union-attr]
    assert [c.name for c in by_flight] == [
        f"position {axis} {of}" for of in ("first", "second") for axis in ("horizontal", "vertical")
    ]
    assert sum(c.redundancy for c in by_camera) == pytest.approx(np.nansum(found.observations.redundancy))
    # half the sigma is four times the variance; the first step does not reach it, since wrong weights share it out
    assert by_camera[1].factor > 2 * by_camera[0].factor and by_flight[2].factor > 2 * by_flight[0].factor
    for _ in range(3):
        found = statistics_of(found.reweighted(1e3, found.components_by(camera[image])), Linear())
    std_px = found.problem.observations.std_px
    one, other = (float(np.median(std_px[camera[image] == k])) for k in (0, 1))
    assert one == pytest.approx(other, rel=0.1) and one == pytest.approx(problem.observations.std_px[0], rel=0.1)
    with pytest.raises(JaxbaError, match=r"components_by: \(3,\) labels for the 20 rows of position; give one a row"):
        found.components_by([1, 2, 3], "position")
