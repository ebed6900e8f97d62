"""How every figure of a report was computed, in words that a customer understands."""

GLOSSARY = {
    "Bundle adjustment": (
        "All photos, cameras and points are solved for together, so that every image point and every other "
        "measurement is met as well as their sigmas allow (least squares, with a loss that lets go of errors)."
    ),
    "Sigma": (
        "By how much a value is expected to be wrong, as far as the measurements can show it: two of three errors "
        "are smaller, nineteen of twenty are under twice the sigma. Sigmas here are those of the adjustment: they "
        "follow from the geometry of the block and from how far its measurements scatter, and hold what all "
        "measurements are off in common only where something tells it."
    ),
    "Error ellipse": (
        "Where a place is known differently in different directions, its sigma is an ellipse. Drawn are those of "
        "one sigma in the plane, which hold the truth in 39% of cases."
    ),
    "Reprojection error": (
        "Distance in the photo, in pixels, between a measured image point and the place where the adjusted camera "
        "sees the adjusted point."
    ),
    "Limit of errors": (
        "Image points are rejected where their error is over the median by more than a factor times the median "
        "absolute deviation (MAD), since errors so large come from wrong matches: adjust.mad_factor. The limit is "
        "not under 3.5 sigmas, nor where the loss begins to let go (adjust.f_scale), nor over "
        "adjust.track_threshold. Points of few photos are held to less, since they fit better by chance."
    ),
    "Systematic residuals": (
        "Residuals averaged over each part of the sensor, and along the radius. Where the camera model fits the "
        "lens, what is left has no pattern."
    ),
    "Ground sample distance": "Side of a pixel on the ground: height above ground over focal length, in the median.",
    "Intrinsics": (
        "Focal length (fx, fy), principal point (cx, cy) and distortion (k1, k2, k3 radial, p1, p2 tangential) of a "
        "camera, in OpenCV's model, found by the adjustment together with all else."
    ),
    "Correlation": (
        "How far two unknowns can be exchanged for each other: near +1 or -1 the block knows their combination well "
        "and each of them badly."
    ),
    "Positions of photos": (
        "Residuals are adjusted minus measured. Measured positions count with the sigmas that the photos or lists "
        "state, changed to what they scatter by: larger where they contradict the block; smaller, down to a tenth, "
        "for a single receiver, most of whose error all photos have in common and which is not in them. Positions "
        "that contradict the block are let go of."
    ),
    "Offset in common": (
        "What all measured positions are off alike, as a base at a wrong place makes them. Without control points "
        "nothing shows it, and no sigma holds it."
    ),
    "Control point": (
        "A surveyed point that holds the block. It is tested against all else before it may pull; one that "
        "contradicts the others is set aside and named."
    ),
    "Check point": (
        "A surveyed point that takes no part in the adjustment and is compared with the result: the only "
        "independent statement of accuracy."
    ),
    "Over sigma": (
        "Difference between the survey of a point and what all else says of it, over the sigma of that difference; "
        "the largest axis counts. Chance makes one of a thousand larger than 3.3."
    ),
    "Without the point": "Where the block would have a control point if that point had held nothing, minus the survey.",
    "Smallest error that shows": (
        "An error of a control point of this size is found by a test at 0.1% in four of five cases (internal "
        "reliability, Baarda). Smaller ones may stay unseen."
    ),
    "What it would do": "By how much an error of that size would move the point in the result (external reliability).",
    "Redundancy": (
        "How many measurements there are beyond those that are needed. Where it is small, errors do not show."
    ),
    "Variance component": (
        "How far one kind of measurement really scatters, from its residuals and its redundancy (Helmert, "
        "Foerstner), beside the sigma that it was taken with."
    ),
    "Variance factor": "Squared residuals over their sigmas, a redundant measurement: 1 where sigmas are right.",
    "ASPRS accuracy": (
        "By the Positional Accuracy Standards of 2023, edition 2: the RMSE of check points and the sigma of their "
        "survey, squared, added and rooted. Thirty check points state it."
    ),
    "Scale bar": "A measured distance between two marked points. It is tested against all else before it may pull.",
    "Overlap": (
        "Photos that see the middle of a cell of the ground, by the adjusted cameras. Points of fewer than three "
        "are weak."
    ),
    "Traffic light": "A figure held against limits that stand beside it. They are customs of the trade, not a promise.",
}
