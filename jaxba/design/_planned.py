"""The network of a plan: photos at its stations, as a flight would come to lie, over gentle hills."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxba.design._flight_plan import FlightPlan
from jaxba.design._ground import Ground, ground_of_terrain
from jaxba.design._network import Network
from jaxba.design._photos import Photos, problem_of
from jaxba.design._stations import Stations, stations_of
from jaxba.design._variants import with_control
from jaxba.geometry import OpenCV
from jaxba.simulation import smooth_terrain

_PLACE_JITTER_M, _ATTITUDE_JITTER_RAD = 0.5, 0.02  # of an autopilot about its plan
_SEED = 0


def network_of(plan: FlightPlan) -> Network:
    """Return the network that a plan would make; the same one each time.

    Raises `JaxbaError` where it makes no block.
    """
    photos, ground = photos_of(plan, stations_of(plan))
    problem = problem_of(photos, ground, plan.ties, plan.gnss, seed=_SEED)
    network = Network(photos, ground, problem, plan.area_m, plan.control.mark_std_px)
    if not len(plan.control_m):
        return network
    control = plan.control
    return with_control(network, plan.control_m, (control.std_h_m, control.std_h_m, control.std_v_m))


def photos_of(plan: FlightPlan, stations: Stations) -> tuple[Photos, Ground]:
    """Return the photos of a flight that errs about its plan, and the ground below."""
    flight_rng, terrain_rng = np.random.default_rng(_SEED).spawn(2)
    shift, turn = flight_rng.normal(size=(2, len(stations.center_m), 3))
    rotation = Rotation.from_rotvec(_ATTITUDE_JITTER_RAD * turn).as_matrix() @ stations.cam_from_world
    camera = plan.camera
    photos = Photos(
        stations.center_m + _PLACE_JITTER_M * shift,
        rotation,
        OpenCV(
            *(np.array([value]) for value in (camera.focal, camera.focal, camera.width_px / 2, camera.height_px / 2)),
            *np.zeros((5, 1)),
        ),
        np.zeros(len(rotation), np.int32),
        (camera.width_px, camera.height_px),
    )
    terrain = smooth_terrain(terrain_rng, plan.ground.relief_m, plan.flight.height_m)
    reach = 2 * plan.flight.height_m
    low, high = stations.center_m[:, :2].min(axis=0) - reach, stations.center_m[:, :2].max(axis=0) + reach
    return photos, ground_of_terrain(terrain, low, high)
