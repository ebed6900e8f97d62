"""How every figure was computed, in words that a customer understands; terms are the words of the page's headings."""

GLOSSARY = {
    "Bundle adjustment": (
        "All photos, cameras and points are solved for together, so that every image point and every other "
        "measurement is met as well as their sigmas allow (least squares, with a loss that lets go of errors)."
    ),
    "Verdict": (
        "No better than the poorest of the figures under it. Each is held against limits that stand beside it; they "
        "are customs of the trade, not a promise."
    ),
    "Adjusted minus measured": (
        "The sign of all differences: positive where the result lies farther east, farther north or higher than was "
        "measured, a scale bar is longer in it, or an image point lies farther right or lower."
    ),
    "Sigma": (
        "By how much a value is expected to be wrong, as far as the measurements can show it: two of three errors "
        "are smaller, nineteen of twenty are under twice the sigma. Sigmas here are those of the adjustment: they "
        "follow from the geometry of the block and from how far its measurements scatter."
    ),
    "Within the block": (
        "Photos that a receiver without control has placed may all be off alike, which moves the block as a whole and "
        "changes nothing in it. A sigma within the block leaves that out: it tells how well distances, areas and "
        "differences of height inside the block are known."
    ),
    "Absolute accuracy": (
        "How far a point may lie from its true coordinates, what the whole block is off included. Check points tell it "
        "best, then control points; the sigma of one position is all that a single receiver tells of it."
    ),
    "Error ellipse": (
        "Where a place is known differently in different directions, its sigma is an ellipse. Drawn are those of "
        "one sigma in the plane, which hold the truth in 39% of cases."
    ),
    "Tie points": (
        "Points of the scene that were found in several photos by themselves and tie these together; in the table of "
        "photos, how many of them the photo shows that take part."
    ),
    "Reprojection error": (
        "Distance in the photo, in pixels, between a measured image point and the place where the adjusted camera "
        "sees the adjusted point. Image points are rejected where it is over the median by more than a factor times "
        "the median absolute deviation (MAD), since errors so large come from wrong matches: adjust.mad_factor. The "
        "limit is not under 3.5 sigmas, nor where the loss begins to let go (adjust.f_scale), nor over "
        "adjust.track_threshold. Points of few photos are held to less, since they fit better by chance."
    ),
    "Mean errors over the sensor": (
        "Residuals averaged over each part of the sensor, and along the radius. Where the camera model fits the "
        "lens, what is left has no pattern."
    ),
    "Ground sample distance": "Side of a pixel on the ground: height above ground over focal length, in the median.",
    "Camera calibration": (
        "Focal length (fx, fy), principal point (cx, cy) and distortion (k1, k2, k3 radial, p1, p2 tangential) of a "
        "camera, its intrinsics, in OpenCV's model, found by the adjustment together with all else."
    ),
    "Correlation": (
        "How far two unknowns can be exchanged for each other: near +1 or -1 the block knows their combination well "
        "and each of them badly."
    ),
    "GNSS positions": (
        "Places of the camera that the drone's receiver measured. Those that contradict the block are let go of and "
        "hardly count; those that were not trusted beforehand are left out and do not count."
    ),
    "Sigma as stated": "What photos, lists or parameters say that a measurement is good to.",
    "Sigma as used": (
        "What the adjustment weighed a measurement with. Positions get what they scatter by: more than was stated "
        "where they contradict the block; less, down to a tenth, for a single receiver, most of whose error all photos "
        "have in common and which is not in them."
    ),
    "Offset in common": (
        "What all measured positions are off alike, as a base at a wrong place makes them. Without control points "
        "nothing shows it: it is not determined then, and no sigma holds it."
    ),
    "Mean direction": (
        "Mean of angles, which are on a circle: the direction of the mean of unit vectors, so that 359 and 1 degrees "
        "have the mean 0."
    ),
    "Circular spread": "Standard deviation of angles about their mean direction: sqrt(-2 ln R), R the mean's length.",
    "Control point": (
        "A surveyed point that holds the block. It is tested against all else before it may pull; one that "
        "contradicts the others is set aside and named."
    ),
    "Check point": (
        "A surveyed point that takes no part in the adjustment and is compared with the result: the only "
        "independent statement of accuracy."
    ),
    "Off by": (
        "Difference between the survey of a point and what all else says of it, over the sigma of that difference; "
        "the largest axis counts. Chance makes one of a thousand larger than 3.3."
    ),
    "Redundancy": (
        "How many measurements there are beyond those that are needed. Where it is small, errors do not show."
    ),
    "Redundancy number": (
        "The share of one measurement in the redundancy, 0 to 1: of an error in it, so much shows in its residual."
    ),
    "Residual without the point": (
        "Where the block would have a control point if that point had held nothing, minus the survey."
    ),
    "Internal reliability": (
        "The minimal detectable error: one of this size in the survey of a control point is found by a test at 0.1% in "
        "four of five cases (Baarda). Smaller ones may stay unseen."
    ),
    "External reliability": "By how much an error of that size, unseen, would move the point in the result.",
    "Variance components": (
        "How far one kind of measurement really scatters, from its residuals and its redundancy (Helmert, "
        "Foerstner), beside the sigma as stated and the sigma as used."
    ),
    "Variance factor": "Squared residuals over their sigmas, a redundant measurement: 1 where sigmas are right.",
    "Accuracy by check points": (
        "By the Positional Accuracy Standards of ASPRS, 2023, edition 2: the RMSE of check points and the sigma of "
        "their survey, squared, added and rooted. Thirty check points state it."
    ),
    "Scale bars": (
        "Measured distances between two marked points. They are tested against all else before they may pull."
    ),
    "Overlap": (
        "Photos that see the middle of a cell of the ground, by the adjusted cameras. Points of fewer than three "
        "are weak."
    ),
}
