"""A made-up report of a survey with everything that a report can hold, for tests of its page.

Numbers come from a generator with a fixed seed. They are plausible, and they are no one's survey.
"""

import math
from typing import Any

import numpy as np

from jaxba.report.document._glossary import GLOSSARY

EAST, NORTH, GROUND, HEIGHT = 523_400.0, 4_612_800.0, 212.0, 292.0
FORWARD, ACROSS = 12.0, 22.0  # spacing of photos along and between strips
UNKNOWN = {"none": "This part was not computed in this run."}


def sample(num_photos: int = 24, num_points: int = 2000) -> dict[str, Any]:
    """Return a report of that many photos and points; the last three photos are not adjusted or are left out."""
    rng = np.random.default_rng(7)
    photos = _photos(rng, num_photos)
    adjusted = sum(photo["state"] == "adjusted" for photo in photos)
    return {
        "schema": 1,
        "project": {
            "name": "Harbour quarry, north face", "photos": "flights/2024-05-02", "jaxba": "0.1.0",
            "state": "stopped", "reason": "The run was stopped by Ctrl-C in the stage export.",
            "crs": "EPSG:32615+5773", "crs_name": "WGS 84 / UTM zone 15N + EGM96 height", "unit": "metre",
            "height_unit": "metre", "heights": "Heights are above the geoid EGM96.",
            "first_photo": "2024-05-02T10:31:07", "last_photo": "2024-05-02T10:58:44", "outputs": "export",
        },
        "verdict": {
            "state": "fair",
            "text": "The block is complete and agrees with its check points, but two photos could not be adjusted.",
        },
        "quality": _quality(adjusted, num_photos),
        "findings": [
            "Photo DJI_0022.JPG matches no other photo: it shows water only.",
            "Control point GCP4 is off by 3.4 sigmas in height. Look at its marks and at its survey.",
            "The focal length and the flying height go together (correlation 0.93): add oblique photos.",
        ],
        "summary": [
            {"name": "Photos adjusted", "value": f"{adjusted} of {num_photos}"},
            {"name": "Ground sample distance", "value": "2.1 cm"},
            {"name": "Area", "value": "1.9 ha"},
            {"name": "Points", "value": f"{4 * num_points:,}"},
            {"name": "Reprojection error, median", "value": "0.61 px"},
            {"name": "Check points, 3D RMSE", "value": "0.031 m"},
        ],
        "sigmas": {
            "scope": "absolute", "text": "Sigmas are absolute, in the frame of the control points.",
            "camera_m": [0.012, 0.013, 0.021], "point_m": [0.014, 0.014, 0.028],
            "absolute_m": [0.02, 0.02, 0.028], "absolute_text": "RMSE of the check points.",
        },
        "cloud": _cloud(rng, photos, num_points),
        "photos": photos,
        "pairs": _pairs(rng, photos),
        "overlap": _overlap(photos),
        "residuals": _residuals(rng),
        "cameras": [_camera()],
        **_calibration(rng),
        **_survey(rng, adjusted),
        "left_out": [
            {"stage": "features", "name": photos[-1]["name"], "reason": "The photo is blurred: 112 keypoints."},
            {"stage": "control", "name": "GCP9", "reason": "It is marked in one photo only; two are needed."},
        ],
        "processing": _processing(rng, photos),
        "glossary": [
            {"term": term, "text": text} for term, text in GLOSSARY.items()
        ],
    }  # fmt: skip


def _quality(adjusted: int, num_photos: int) -> list[dict[str, str]]:
    rows = [
        ("Photos adjusted", f"{adjusted} of {num_photos}", "fair", "Some photos have no place in the block.",
         "good from 95%, poor under 80%"),
        ("Reprojection error", "0.61 px", "good", "Keypoints agree with their points.", "good to 1 px, poor over 2 px"),
        ("Overlap", "6 photos", "good", "Half of the ground is in 6 photos or more.", "good from 5, poor under 3"),
        ("Camera calibration", "0.93", "poor", "Focal length and flying height cannot be told apart.",
         "good to 0.8, poor over 0.9"),
        ("Check points", "0.031 m", "good", "They are met within the target.", "good within the target"),
        ("Scale bars", "", "unknown", "There is none.", "good within 2 sigmas, poor over 3"),
    ]  # fmt: skip
    return [dict(zip(("name", "value", "state", "text", "limits"), row, strict=True)) for row in rows]


def _photos(rng: np.random.Generator, count: int) -> list[dict[str, Any]]:
    columns = max(math.ceil(math.sqrt(1.6 * count)), 1)
    photos = []
    for k in range(count):
        strip, along = divmod(k, columns)
        along = columns - 1 - along if strip % 2 else along
        x, y, z = np.array([EAST + FORWARD * along, NORTH + ACROSS * strip, HEIGHT]) + rng.normal(0, [1.0, 1.0, 0.5])
        off = rng.normal(0, [0.02, 0.02, 0.04])
        left = count > 6 and k >= count - 3
        gated = k % 17 == 5
        if gated:
            off += np.array([1.4, -0.9, 2.0])
        corners = np.array([x, y]) + np.array([[-20, -14], [20, -14], [20, 14], [-20, 14]]) + rng.normal(0, 0.5, (4, 2))
        photos.append({
            "name": f"DJI_{k + 1:04d}.JPG", "camera": 0, "partners": 0 if left else int(rng.integers(6, 18)),
            "time": f"2024-05-02T10:{31 + k // 60 % 28:02d}:{k % 60:02d}",
            "state": ("adjusted" if not left else "left out" if k == count - 1 else "not adjusted"),
            "reason": "It matches no other photo." if left else None,
            **dict.fromkeys(("x", "y", "z"), None),
            **({} if left else {"x": _round(x), "y": _round(y), "z": _round(z)}),
            "std_m": None if left else _round(rng.uniform(0.008, 0.02, 3) * [1, 1, 1.7], 4),
            "ellipse_m": None if left else _round([rng.uniform(0.014, 0.02), 0.010, rng.uniform(0, 180)], 4),
            "measured": _round(np.array([x, y, z]) - off), "residual_m": None if left else _round(off),
            "position": "used" if not gated else "let go" if k % 2 else "left out",
            "omega_phi_kappa_deg": None if left else _round([rng.normal(), 0.3, 90 + 180 * (strip % 2)], 2),
            "observations": 0 if left else int(rng.integers(1800, 5200)),
            "keypoints": None if k == count - 1 else int(rng.integers(7000, 10000)),
            "median_px": None if left else _round(rng.uniform(0.5, 0.7), 2),
            "rms_px": None if left else _round(rng.uniform(0.7, 1.0), 2),
            "max_px": None if left else _round(rng.uniform(3, 4), 2),
            "outline": None if left else _round(corners, 2),
        })  # fmt: skip
    return photos


def _cloud(rng: np.random.Generator, photos: list[dict[str, Any]], count: int) -> dict[str, Any]:
    places = np.array([[photo["x"], photo["y"]] for photo in photos if photo["x"] is not None])
    low, high = places.min(axis=0) - 18, places.max(axis=0) + 18
    xy = rng.uniform(low, high, (count, 2))
    u, v = ((xy - low) / (high - low)).T
    step = 1 / (1 + np.exp(-25 * (u + 0.25 * np.sin(5 * v) - 0.6)))  # a quarry's face
    z = GROUND + 18 * step + 1.5 * np.sin(9 * u) * np.cos(7 * v) + rng.normal(0, 0.1, count)
    grass, rock = np.array([104, 128, 70]), np.array([186, 170, 146])
    rgb = rock + (grass - rock) * step[:, None] + rng.normal(0, 16, (count, 1)) + rng.normal(0, 5, (count, 3))
    return {
        "num_points": 4 * count, "num_shown": count,
        "x": _round(xy[:, 0]), "y": _round(xy[:, 1]), "z": _round(z),
        "rgb": np.clip(rgb, 0, 255).astype(int).tolist(),
        "error_px": _round(rng.gamma(3, 0.2, count)), "std_z_m": _round(rng.gamma(4, 0.006, count), 4),
    }  # fmt: skip


def _pairs(rng: np.random.Generator, photos: list[dict[str, Any]]) -> dict[str, Any]:
    pairs = []
    for i, first in enumerate(photos):
        for j in range(i + 1, min(i + 60, len(photos))):
            second = photos[j]
            if first["x"] is None or second["x"] is None:
                continue
            distance = math.hypot(second["x"] - first["x"], second["y"] - first["y"])
            if distance > 45:
                continue
            putative = int(1500 * math.exp(-distance / 25) + rng.integers(5, 60))
            state = "rejected" if rng.random() < 0.03 else "pruned" if rng.random() < 0.03 else "good"
            state = "weak" if state == "good" and putative < 300 else state
            matches = 0 if state == "rejected" else int(0.8 * putative)
            pairs.append({
                "first": i, "second": j, "matches": matches, "putative": putative, "state": state,
                "median_px": None if state == "rejected" else 0.52, "angle_deg": _round(distance / 1.4, 1),
            })  # fmt: skip
    keys = ("first", "second", "matches", "putative", "state", "median_px", "angle_deg")
    return {key: [pair[key] for pair in pairs] for key in keys}


def _overlap(photos: list[dict[str, Any]]) -> dict[str, Any]:
    places = np.array([[photo["x"], photo["y"]] for photo in photos if photo["x"] is not None])
    low, high, cell = places.min(axis=0) - 20, places.max(axis=0) + 20, 2.0
    columns, rows = np.ceil((high - low) / cell).astype(int)
    x, y = low[0] + cell * (np.arange(columns) + 0.5), low[1] + cell * (np.arange(rows) + 0.5)
    sees = (abs(x - places[:, :1])[:, None, :] <= 20) & (abs(y - places[:, 1:])[:, :, None] <= 14)
    rows = sees.sum(axis=0)
    return {
        "x0": _round(low[0]), "y0": _round(low[1]), "cell": cell, "area_m2": float((rows > 1).sum() * cell**2),
        "median": float(np.median(rows[rows > 0])), "rows": rows.tolist(),
    }  # fmt: skip


def _residuals(rng: np.random.Generator) -> dict[str, Any]:
    rows, columns, width, height = 14, 20, 4000, 3000
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-0.75, 0.75, rows))
    swirl = 0.25 * np.exp(-((x - 0.5) ** 2 + y**2) / 0.2)
    count = rng.integers(20, 400, (rows, columns))
    count[0, :2] = 0
    edges = np.linspace(0, 6, 61)
    kept = 40_000 * edges[:-1] * np.exp(-((edges[:-1] / 0.6) ** 1.2))
    radius = np.linspace(100, 2400, 24)
    return {
        "histogram": {
            "edges_px": _round(edges, 2), "counts": np.where(edges[:-1] < 3.2, kept, 0).astype(int).tolist(),
            "rejected": np.where(edges[:-1] < 3.2, 0, 60 * np.exp(-(edges[:-1] - 3.2))).astype(int).tolist(),
            "threshold_px": 3.2, "median_px": 0.61, "mad_px": 0.29,
        },
        "sensors": [{
            "camera": 0, "width_px": width, "height_px": height, "count": count.tolist(),
            "dx_px": _round(-swirl * y + rng.normal(0, 0.03, x.shape)),
            "dy_px": _round(swirl * (x - 0.5) + rng.normal(0, 0.03, x.shape)),
            "radial": {
                "radius_px": _round(radius, 0), "mean_px": _round(0.08 * np.sin(radius / 500), 4),
                "rms_px": _round(0.5 + 0.2 * (radius / 2400) ** 3, 4), "count": (40 * radius).astype(int).tolist(),
            },
        }],
    }  # fmt: skip


def _camera() -> dict[str, Any]:
    rows = [
        ("focal length", "px", 3650.0, 3671.284, 0.412, False),
        ("principal point x", "px", 2000.0, 1992.31, 0.21, False),
        ("principal point y", "px", 1500.0, 1506.77, 0.24, False), ("k1", "", 0.0, -0.01342, 0.00011, False),
        ("k2", "", 0.0, 0.00871, 0.00035, False), ("k3", "", None, 0.0, None, True),
        ("p1", "", 0.0, -0.000213, 0.000012, False), ("p2", "", 0.0, 0.000087, 0.000013, False),
    ]  # fmt: skip
    keys = ("name", "unit", "start", "value", "std", "fixed")
    return {
        "name": "DJI FC6310 8.8 mm", "model": "Brown-Conrady", "num_photos": 24, "width_px": 4000, "height_px": 3000,
        "focal_from": "the tags and the size of the sensor",
        "parameters": [dict(zip(keys, row, strict=True)) | _change(row) for row in rows],
    }  # fmt: skip


def _change(row: tuple[Any, ...]) -> dict[str, float | None]:
    _, _, start, value, std, _ = row
    change = None if start is None else round(value - start, 6)
    return {"change": change, "change_over_sigma": None if change is None or std is None else change / std}


def _calibration(rng: np.random.Generator) -> dict[str, Any]:
    names = ["focal length", "principal point x", "principal point y", "k1", "k2", "p1", "p2"]
    spread = rng.normal(size=(len(names), 10))
    spread[4] = -0.9 * spread[3] + 0.3 * spread[4]
    kinds = [
        ("tie points", "px", 96_412, 71_227.4, 0.71, 0.004, None, 0.66, True),
        ("marks", "px", 64, 51.2, 0.4, 0.1, 0.5, 0.5, True),
        ("position horizontal", "m", 42, 21.7, 0.021, 0.15, 0.02, 0.02, True),
        ("position up", "m", 21, 6.7, 0.043, 0.23, 0.05, 0.05, False),
        ("assumed beforehand", "", 9, 9.0, None, None, None, None, None),
    ]  # fmt: skip
    keys = ("name", "unit", "count", "redundancy", "std", "std_share", "taken_std", "weighed_std", "is_known")
    return {
        "correlation": {"names": names, "matrix": _round(np.corrcoef(spread), 3)},
        "statistics": {
            "redundancy": 71_316, "variance_factor": 1.04,
            "kinds": [dict(zip(keys, row, strict=True)) for row in kinds],
        },
    }  # fmt: skip


def _survey(rng: np.random.Generator, adjusted: int) -> dict[str, Any]:
    points = []
    for k in range(9):
        place = np.array([EAST + 18 * (k % 4), NORTH + 14 * (k // 2), GROUND + k])
        off = rng.normal(0, [0.012, 0.012, 0.022])
        points.append({
            "name": f"GCP{k + 1}", "role": "check" if k > 4 else "control", "marks": 6 + k, "marks_used": 6 + k - k % 2,
            "surveyed": _round(place), "adjusted": _round(place + off), "residual_m": _round(off),
            "std_m": [0.008, 0.008, 0.014], "without_std_m": [0.013, 0.013, 0.022],
            "survey_std_m": [0.01, 0.01, 0.015], "mark_rms_px": 0.42,
            "over_sigma": 3.4 if k == 3 else _round(rng.uniform(0.3, 1.9), 2), "set_aside": ["up"] if k == 3 else [],
            "redundancy": [0.0 if k == 0 else 0.42, 0.42, 0.38],
            "without_m": _round(1.6 * off), "detectable_m": ["any" if k == 0 else 0.06, 0.06, 0.11],
            "reach_m": [0.01, 0.01, None if k == 0 else 0.03], "suspect": k == 3,
        })  # fmt: skip
    bar = dict.fromkeys(("length_m", "adjusted_m"), 1.2) | {"std_m": 0.0005, "adjusted_std_m": 0.0009}
    return {
        "positions": {
            "num": adjusted - 1, "num_let_go": 1, "num_left_out": 1,
            "mean_m": [0.001, -0.002, 0.004], "rms_m": [0.021, 0.019, 0.043],
            "stated_m": [0.02, 0.02, 0.05], "taken_m": [0.02, 0.02, 0.05],
            "common_m": [0.012, -0.031, None], "common_std_m": [0.006, 0.006, None],
            "flights": [{"number": 1, "num_photos": adjusted, "offset_m": [0.01, -0.03, 0.09],
                         "std_m": [0.006, 0.006, 0.01]}],
        },
        "attitudes": {"num": adjusted, "names": ["about east", "about north", "about up"], "mean_deg": [0.4, -0.1, 0.2],
                      "spread_deg": [1.3, 0.4, 0.5], "contradict": []},
        "control": {
            "method": "adjust", "num_control": 5, "num_check": 4,
            "control_rms_m": [0.011, 0.012, 0.02], "check_rms_m": [0.014, 0.013, 0.024],
            "check_shift_m": [0.002, -0.004, 0.011], "check_shift_std_m": [0.006, 0.006, 0.011], "points": points,
        },
        "bars": {"bars": [
            {"first": "A1", "second": "A2", "role": "control", "residual_m": 0.0004, "over_sigma": 0.4, "used": True,
             "set_aside": False, **bar},
            {"first": "B1", "second": "B2", "role": "check", "residual_m": -0.0011, "over_sigma": 1.1, "used": False,
             "set_aside": False, **bar},
        ]},
        "accuracy": {
            "text": "Tested by 4 check points; ASPRS (2023) asks for 30 to state an accuracy.",
            "rows": [
                {"name": "horizontal", "num": 4, "fit_m": 0.019, "survey_m": 0.014, "product_m": 0.024,
                 "target_m": 0.05, "state": "good"},
                {"name": "vertical", "num": 4, "fit_m": 0.024, "survey_m": 0.015, "product_m": 0.028, "target_m": None,
                 "state": "unknown"},
            ],
            "blunders": [],
        },
    }  # fmt: skip


def _processing(rng: np.random.Generator, photos: list[dict[str, Any]]) -> dict[str, Any]:
    def hashed(name: str, **more: str) -> dict[str, str]:
        return {"name": name, **more, "sha256": rng.bytes(32).hex()}

    return {
        "parameters": [
            {"section": "features", "name": "detector", "value": "sift", "default": "sift", "changed": False},
            {"section": "features", "name": "max_keypoints", "value": "10000", "default": "8000", "changed": True},
            {"section": "crs", "name": "target_crs", "value": "EPSG:32615+5773", "default": "auto", "changed": True},
        ],
        "stages": [
            {"name": "metadata", "seconds": 0.8, "lines": ["24 photos of one camera, positions in all."]},
            {"name": "features", "seconds": 41.2, "lines": ["8,412 keypoints a photo."]},
            {"name": "match", "seconds": 66.0, "lines": ["142 pairs matched.", "5 pairs rejected."]},
            {"name": "adjust", "seconds": 12.4, "lines": ["The adjustment converged in 9 steps."]},
            {"name": "export", "seconds": None, "lines": []},
        ],
        "versions": [{"name": "jaxba", "version": "0.1.0"}, {"name": "jax", "version": "0.8.1"}],
        "inputs": [hashed("gcp_list.txt", what="gcp"), *(hashed(photo["name"], what="photo") for photo in photos)],
        "outputs": [hashed("cloud.laz"), hashed("cameras.csv")],
    }  # fmt: skip


def _round(values: Any, digits: int = 3) -> Any:
    return np.round(np.asarray(values, float), digits).tolist()
