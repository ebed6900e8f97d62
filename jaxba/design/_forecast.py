"""What a network would give, as plain values: sigmas over the area, weakest modes, and what more would gain."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.design._modes import dome_std_m, shift_std_m, weakest_modes
from jaxba.design._network import Network
from jaxba.design._place import Place
from jaxba.design._placement import place_control
from jaxba.design._sections import Control, Gnss
from jaxba.design._variants import with_control, with_oblique, with_positions, with_second_height

_CONTROL_POINTS = 4  # that the table of gains asks about


def forecast(network: Network) -> dict[str, Any]:
    """Return what a network would give.

    - `ground`: sigmas of spots over the area, marked in all photos that show them: median and largest, east, north, up,
      metres; `worst_at_m`: where the largest of all is. `rays`: least and median photos that show a spot.
    - `cameras`: median sigma of the photos' positions. `focal_std_px`: sigma of the focal length.
    - `shift_std_m`: of the area as a whole. `dome_std_m`: of its middle against its corners, by a dome alone.
    - `modes`: the weakest ones, see `weakest_modes`.
    """
    spots = network.spots
    std_m = spots.std_m
    worst = int(np.argmax(std_m.max(axis=1)))
    return {
        "photos": network.photos.num,
        "ground": {
            "median_std_m": np.median(std_m, axis=0).tolist(),
            "worst_std_m": std_m.max(axis=0).tolist(),
            "worst_at_m": spots.xyz_m[worst, :2].tolist(),
            "rays": [float(spots.rays.min()), float(np.median(spots.rays))],
        },
        "cameras": {"median_std_m": np.median(network.position_std_m, axis=0).tolist()},
        "focal_std_px": network.focal_std_px,
        "shift_std_m": shift_std_m(network).tolist(),
        "dome_std_m": dome_std_m(network),
        "modes": [
            {
                "name": mode.name,
                "share": mode.share,
                "corners_m": mode.corners_m.tolist(),
                "middle_m": mode.middle_m.tolist(),
            }
            for mode in weakest_modes(network)
        ],
    }


def gains(network: Network, control: Control, say: Callable[[str], None] = lambda name: None) -> list[dict[str, Any]]:
    """Return what more photos, better positions or control would gain, a row each; the first is the network's own.

    - `control`: sigmas of more control points. `say`: told the name of each row before it is computed.

    A row has `name`, and `photos`, `worst_std_m`, `median_std_m`, `dome_std_m` and `focal_std_px` as `forecast` has
    them, or where it cannot be computed `none`, the reason.
    """
    ways: list[tuple[str, Callable[[], Network]]] = [("as it is", lambda: network)]
    ways.append(("with oblique photos around it", lambda: with_oblique(network)))
    ways.append(("with half of it flown 1.3 times as high, across", lambda: with_second_height(network)))
    if _is_plain(network):
        ways.append(("with RTK positions", lambda: with_positions(network, Gnss(kind="rtk"))))
    std_m = control.std_h_m, control.std_h_m, control.std_v_m
    ways.append(
        (
            f"with {_CONTROL_POINTS} more control points where they help most",
            lambda: with_control(network, place_control(network, _CONTROL_POINTS, std_m).plan_m, std_m),
        )
    )
    rows = []
    for name, make in ways:
        say(name)
        try:
            made = make()
            rows.append({"name": name, **_row(made)})
        except JaxbaError as error:
            rows.append({"name": name, "none": str(error)})
    return rows


def improved(network: Network, count: int, control: Control, place: Place) -> dict[str, Any]:
    """Return where control points help most, in the plan's coordinates too, and what each is worth."""
    placed = place_control(network, count, (control.std_h_m, control.std_h_m, control.std_v_m))
    coordinates = place.coordinates(placed.plan_m)
    return {
        "worst_std_m": placed.worst_m,
        "worst_before_m": placed.before_m,
        "typical_std_m": placed.typical_m,
        "typical_before_m": placed.typical_before_m,
        "unit": place.unit,
        "points": [
            {
                "name": f"C{k}",
                "x": float(x),
                "y": float(y),
                "east_m": float(e),
                "north_m": float(n),
                "without_m": float(w),
            }
            for k, ((x, y), (e, n), w) in enumerate(
                zip(coordinates, placed.plan_m, placed.without_m, strict=True), start=1
            )
        ],
    }


def _row(network: Network) -> dict[str, Any]:
    std_m = network.spots.std_m
    return {
        "photos": network.photos.num,
        "worst_std_m": float(std_m.max()),
        "median_std_m": np.median(std_m, axis=0).tolist(),
        "dome_std_m": dome_std_m(network),
        "focal_std_px": network.focal_std_px,
    }


def _is_plain(network: Network) -> bool:
    """Whether positions are worse than those of an RTK receiver."""
    prior = network.problem.prior("position")
    if prior is None:
        return True
    std_m: Float[np.ndarray, "rows 3"] = np.asarray(vars(prior)["std_m"], float)
    return bool(np.median(std_m[:, 0]) > 2 * Gnss(kind="rtk").std_m[0])
