"""Findings of an audit with the words that they are told in."""

from jaxba.scene import Finding

NAN, INF = float("nan"), float("inf")
AUDIT_CASES = [
    (
        Finding.of("audit note", text="What was decided."),
        "What was decided.",
    ),
    (
        Finding.of(
            "claim differs", name="points", unit="", stated=310.0, recomputed=300.0, limit=0.0,
            place="points3D.txt, line 3",
        ),
        "The files state 310 for the points, and their own numbers give 300: 10 apart (points3D.txt, line 3). The "
        "statement is of another state of the model: export it again.",
    ),
    (
        Finding.of(
            "claim differs", name="mean reprojection error", unit="px", stated=0.41, recomputed=0.355, limit=0.01,
            place="points3D.txt, errors of 1,138 points",
        ),
        "The files state 0.41 px for the mean reprojection error, and their own numbers give 0.355 px: 0.055 px apart, "
        "over the 0.01 px that rounding explains (points3D.txt, errors of 1,138 points). The statement is of another "
        "state of the model: export it again.",
    ),
    (
        Finding.of(
            "point errors differ", count=1, num_stated=11384, name="7683", stated=0.9, recomputed=0.2365, unit="px",
            limit=0.01,
        ),
        "The errors that the files state of 1 of 11,384 points are not those of their observations, by more than 0.01 "
        "px and 1%: of point 7683 0.9 px are stated, 0.2365 computed. Points, poses or cameras were changed after they "
        "were written: export the model again.",
    ),
    (
        Finding.of(
            "intrinsics off", cameras=["1"], parameters=["f"], before=[1344.57], after=[1280.53], std=[0.92],
            over_sigma=[69.6], apart_px=[19.3], least_px=[1.024], limit_sigma=4.0,
        ),
        "An intrinsic is not what the model's own measurements say: focal length f of camera 1 is 1344.57 where they "
        "give 1280.53 with a sigma of 0.92, which is +5.0% off, 69.6 sigmas, and moves pixels by up to 19.3 (1.0). "
        "Limits are 4 sigmas, and the pixels that stand in brackets. Adjust the model again with it free, or compare "
        "with a calibration.",
    ),
    (
        Finding.of(
            "intrinsics off", cameras=list("abcdef"), parameters=["k1"] * 6, before=[0.0] * 6, after=[-0.05] * 6,
            std=[0.001] * 6, over_sigma=[50.0] * 6, apart_px=[5.0] * 6, least_px=[1.0] * 6, limit_sigma=4.0,
        ),
        "6 intrinsics are not what the model's own measurements say: "
        + "; ".join(
            f"k1 of camera {name} is 0 where they give -0.05 with a sigma of 0.001, 50.0 sigmas, and moves pixels by "
            "up to 5.0 (1.0)"
            for name in "abcd"
        )
        + "; and 2 more. Limits are 4 sigmas, and the pixels that stand in brackets. Adjust the model again with these "
        "free, or compare with a calibration.",
    ),
    (
        Finding.of(
            "images off", names=["a.jpg"], shift=[0.2452], turn_deg=[0.00066], over_sigma=[97.2], apart_px=[33.2],
            unit="", others_px=0.0163, limit_sigma=4.61, least_px=1.0,
        ),
        "1 image does not stand where its own measurements put it: a.jpg (by 0.245 of its units and 0.00066 degrees, "
        "97 sigmas, 33 px). Limits are 4.6 sigmas and 1.0 px, where the median of all images is 0.016 px. Adjust the "
        "model again, or take these images out.",
    ),
    (
        Finding.of(
            "images off", names=["a.jpg", "b.jpg"], shift=[2.4, 1.2], turn_deg=[0.5, 0.1], over_sigma=[97.2, NAN],
            apart_px=[INF, 33.2], unit="m", others_px=0.0163, limit_sigma=4.61, least_px=1.0,
        ),
        "2 images do not stand where their own measurements put them: a.jpg (by 2.4 m and 0.5 degrees, 97 sigmas, "
        "behind its points), b.jpg (by 1.2 m and 0.1 degrees, 33 px). Limits are 4.6 sigmas and 1.0 px, where the "
        "median of all images is 0.016 px. Adjust the model again, or take these images out.",
    ),
    (
        Finding.of(
            "wrong matches", count=36, observations=1800, limit_px=5.02, std_px=0.502, least_share=0.01,
            names=["a.jpg", "b.jpg"], shares=[0.033, 0.028],
        ),
        "36 of 1,800 observations (2.0%) are wrong matches: they miss their points by more than 5.0 px, where the "
        "others scatter with a sigma of 0.50 px; up to 1% is usual. Most in a.jpg (3%), b.jpg (3%). Filter the "
        "matches, and adjust with a robust loss.",
    ),
    (
        Finding.of("points behind", count=3, points=2, names=["a.jpg", "b.jpg"]),
        "3 observations show points that lie behind their camera (2 points; in a.jpg, b.jpg): no camera sees these. "
        "Take them out.",
    ),
    (
        Finding.of("rays near parallel", count=120, points=1000, angle_deg=1.5, least_share=0.05),
        "120 of 1,000 points (12.0%, where up to 5% is usual) are seen under angles below 1.5 degrees alone: their "
        "distance is hardly known. Take them out, or photograph from farther apart.",
    ),
]  # fmt: skip
