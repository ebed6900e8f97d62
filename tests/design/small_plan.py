"""One small plan, and its network, which the tests of design share: 20 photos over 80 x 60 m."""

import functools

import numpy as np

from jaxba.design import FlightPlan, Network, network_of
from jaxba.design._sections import Camera, Flight, Gnss, Ties

AREA_M = np.array([[-40.0, -30.0], [40.0, -30.0], [40.0, 30.0], [-40.0, 30.0]])
CONTROL_STD_M = 0.01, 0.01, 0.015


def small_plan(kind: str = "rtk", **flight: object) -> FlightPlan:
    """Return the plan with positions of a kind, and other values of its flight."""
    usual = {"height_m": 60.0, "forward_overlap": 0.65, "side_overlap": 0.55}
    return FlightPlan(
        area_m=AREA_M,
        camera=Camera(width_px=2000, height_px=1500, focal_px=1600.0),
        flight=Flight(**{**usual, **flight}),
        gnss=Gnss(kind=kind),
        ties=Ties(points_per_image=60.0),
    )


@functools.cache
def small_network(kind: str = "rtk") -> Network:
    """Return its network; not to be changed."""
    return network_of(small_plan(kind))
