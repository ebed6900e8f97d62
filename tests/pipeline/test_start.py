"""The stage start hands on a block whose unknown parts other stages can trust: names, indices, parameters checked."""

import dataclasses
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from jaxba._errors import JaxbaError
from jaxba.pipeline import start


@pytest.fixture(scope="module")
def surveys() -> ModuleType:
    """The simulated surveys that the tests of `jaxba.sfm` use."""
    path = Path(__file__).parents[1] / "sfm" / "surveys.py"
    spec = importlib.util.spec_from_file_location("start_surveys", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def inputs(surveys: ModuleType) -> start.Inputs:
    case = surveys.make_case(12, seed=9, wrong_edges=0.1)
    return start.Inputs(photos=case.photos, reference=case.reference, view_graph=case.view_graph, tracks=case.tracks)


def test_observations_are_those_of_the_tracks(inputs: start.Inputs) -> None:
    block, tracks = start.run(inputs, start.Params()).block, inputs.tracks
    measured = {
        (int(t), int(i)): tuple(xy)
        for t, i, xy in zip(tracks.track_index, tracks.image_index, tracks.xy_px, strict=True)
    }
    assert block.num_images == 12 and block.num_points > 0.97 * tracks.num_tracks
    for image, point, xy in zip(block.observation_image, block.observation_point, block.observation_xy_px, strict=True):
        assert measured[int(block.track_index[point]), int(block.image_index[image])] == tuple(xy)


def test_a_larger_least_angle_leaves_out_points(inputs: start.Inputs) -> None:
    few, many = (start.run(inputs, start.Params(min_angle=angle)).block for angle in (10.0, 1.5))
    assert few.num_points < many.num_points
    assert set(few.track_index) <= set(many.track_index)


def test_the_camera_model_is_the_one_asked_for(inputs: start.Inputs) -> None:
    block = start.run(inputs, start.Params(camera_model="RADIAL")).block
    assert block.camera_model == "RADIAL"
    assert block.camera_parameters.shape == (1, 5)
    # k1 of the true camera, with its k2 and tangential terms on top
    assert block.camera_parameters[0, 3] == pytest.approx(-0.045, abs=0.03)


def test_photos_of_one_camera_with_two_sizes_are_an_error_that_names_them(inputs: start.Inputs) -> None:
    photos = (dataclasses.replace(inputs.photos[0], width_px=4000), *inputs.photos[1:])
    with pytest.raises(JaxbaError, match=r"camera c: its photos have 2 sizes"):
        start.run(dataclasses.replace(inputs, photos=photos), start.Params())


def test_a_parameter_out_of_range_states_the_range() -> None:
    with pytest.raises(JaxbaError, match=r"start.min_angle=20.* is out of range; allowed: 0.1 to 10"):
        start.Params(min_angle=20.0)


def test_importing_the_stage_loads_no_jax() -> None:
    code = "import sys, jaxba.pipeline.start; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_outputs_are_finite(inputs: start.Inputs) -> None:
    block = start.run(inputs, start.Params()).block
    for array in (block.quaternion, block.translation_m, block.points_m, block.camera_parameters):
        assert np.isfinite(array).all()
    np.testing.assert_allclose(np.linalg.norm(block.quaternion, axis=1), 1, rtol=1e-12)
