"""A plan in a file means what it says; what it cannot mean is refused with the parameter, its value and the cure."""

import numpy as np
import pyproj
import pytest

from jaxba._errors import JaxbaError
from jaxba.design import read_plan

PROJECTED = """
[area]
polygon = [[576100, 5183300], [576400, 5183300], [576400, 5183500], [576100, 5183500]]
crs = "EPSG:32615"
[flight]
height_m = 80
[control]
points = [[576120, 5183320]]
"""


def test_projected_coordinates_become_true_metres(tmp_path):
    """UTM's scale is 0.9996 in the middle of a zone: 300 m of the grid are 300.1 m here."""
    path = tmp_path / "flight.toml"
    path.write_text(PROJECTED)
    plan = read_plan(path)
    geod = pyproj.Geod(ellps="WGS84")
    back = pyproj.Transformer.from_crs("EPSG:32615", "EPSG:4326", always_xy=True)
    lon, lat = back.transform([576100, 576400], [5183300, 5183300])
    _, _, length = geod.inv(lon[0], lat[0], lon[1], lat[1])
    assert np.linalg.norm(plan.area_m[1] - plan.area_m[0]) == pytest.approx(length, abs=1e-3)
    np.testing.assert_allclose(plan.place.coordinates(plan.control_m), [[576120.0, 5183320.0]], atol=1e-3)
    assert plan.flight.height_m == 80.0
    assert plan.camera.focal == pytest.approx(3648.0)


def test_degrees_and_metres_mean_the_same_place(tmp_path):
    back = pyproj.Transformer.from_crs("EPSG:32615", "EPSG:4326", always_xy=True)
    corners = [(576100, 5183300), (576400, 5183300), (576400, 5183500), (576100, 5183500)]
    degrees = [list(back.transform(*corner)) for corner in corners]
    path = tmp_path / "degrees.toml"
    path.write_text(f'[area]\npolygon = {degrees}\ncrs = "EPSG:4326"\n')
    plan = read_plan(path)
    np.testing.assert_allclose(plan.place.coordinates(plan.area_m), degrees, atol=1e-9)
    (tmp_path / "grid.toml").write_text(PROJECTED)
    grid = read_plan(tmp_path / "grid.toml")
    sides = [np.linalg.norm(np.diff(area, axis=0), axis=1) for area in (plan.area_m, grid.area_m)]
    np.testing.assert_allclose(*sides, atol=1e-3)
    plain = tmp_path / "plain.toml"
    plain.write_text("[area]\npolygon = [[0, 0], [30, 0], [30, 20]]\n")
    np.testing.assert_allclose(np.ptp(read_plan(plain).area_m, axis=0), [30.0, 20.0])


TRIANGLE = "[area]\npolygon = [[0, 0], [9, 0], [9, 9]]\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[flight]\nheight_m = 80\n", "there is no area.polygon; write"),
        ("[area]\npolygon = [[0, 0], [9, 0]]\n", "area.polygon has 2 corners; give 3 or more"),
        ("[area]\npolygon = [[0, 0], [9, 0], [9]]\n", r"area.polygon: entry 3 is \[9\]; give pairs"),
        ("[area]\npolygon = [[0, 0], [9, 0], [9, nan]]\n", r"area.polygon: entry 3 is \[9, nan\]"),
        ("[area]\npolygon = [[0, 0], [9, 9], [9, 0], [0, 9]]\n", "area.polygon crosses itself"),
        ("[area]\npolygon = [[0, 0], [1e-3, 0], [0, 1e-3]]\n", "for degrees of longitude and latitude write"),
        (TRIANGLE + "foo = 1\n", "no parameter area.foo; the parameters of area are"),
        (TRIANGLE + "crs = 4326\n", "area.crs=4326: give a text"),
        (TRIANGLE + 'crs = "EPSG:1"\n', "area.crs="),
        ('[area]\npolygon = [[500, 0], [509, 0], [509, 9]]\ncrs = "EPSG:4326"\n', "which is no longitude and latitude"),
        (TRIANGLE + "[flight]\nheight_m = 1\n", "flight.height_m=1.0 is out of range; allowed"),
        (TRIANGLE + "[flight]\nheight = 90\n", "no parameter flight.height; did you mean"),
        (TRIANGLE + "[flihgt]\nheight_m = 90\n", "no section 'flihgt'; did you mean flight"),
        (TRIANGLE + '[gnss]\nkind = "rtx"\n', "gnss.kind=rtx is out of range; allowed: rtk"),
        (TRIANGLE + "[control]\npoints = [5]\n", "control.points: entry 1 is 5"),
        (TRIANGLE + "[ground]\nrelief_m = 120\n", "ground.relief_m=120 is over flight.height_m=100"),
        ("[area\n", "is not valid TOML"),
    ],
)  # fmt: skip
def test_what_a_plan_cannot_mean_is_refused(text: str, said: str, tmp_path):
    path = tmp_path / "flight.toml"
    path.write_text(text)
    with pytest.raises(JaxbaError, match=f"^{path}: .*{said}"):
        read_plan(path)


def test_a_file_that_is_not_there_and_a_folder_are_refused(tmp_path):
    with pytest.raises(JaxbaError, match="there is no such file; give a plan"):
        read_plan(tmp_path / "none.toml")
    with pytest.raises(JaxbaError, match="is a folder, and no project"):
        read_plan(tmp_path)
