"""Findings in words: every kind that the adjustment can find has a sentence, made of its figures."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from audit_cases import AUDIT_CASES

import jaxba
from jaxba.engine._key import Key
from jaxba.engine._store import load, save
from jaxba.report import is_to_act_on, sentence
from jaxba.report._findings import WORDS
from jaxba.scene import Finding

NAN, INF = float("nan"), float("inf")
CASES = [
    *AUDIT_CASES,
    (
        Finding.of("note", text="A note."),
        "A note.",
    ),
    (
        Finding.of("no sigmas", text="Sigmas were not computed."),
        "Sigmas were not computed.",
    ),
    (
        Finding.of("sigmas of the shape"),
        "The block has no place on earth: sigmas of positions and points say how well its shape is known, under inner "
        "constraints over its points.",
    ),
    (
        Finding.of("scale bars without ends", names=["a-b", "c-d"]),
        "Scale bars of which fewer than two adjusted photos show an end: a-b, c-d; mark the ends in more photos.",
    ),
    (
        Finding.of(
            "scale bar contradicts",
            name="a-b",
            length_m=12.5,
            residual_m=-0.305,
            over_sigma=20.04,
            limit=3.29,
            is_set_aside=True,
        ),
        "Scale bar a-b contradicts the block: there it is 0.305 m shorter than the 12.5 m that were measured, 20.0 "
        "sigma (limit 3.29). It was set aside. Check the length, its unit and the marks.",
    ),
    (
        Finding.of("scale bars contradict each other", names=["a-b", "c-d"], has_scale=False),
        "Scale bars a-b, c-d contradict each other, and nothing tells which is wrong: all of them were set aside, and "
        "the block has no scale. Check their lengths, units and marks.",
    ),
    (
        Finding.of("scale bars contradict each other", names=["a-b", "c-d"], has_scale=True),
        "Scale bars a-b, c-d contradict each other, and nothing tells which is wrong: all of them were set aside. "
        "Check their lengths, units and marks.",
    ),
    (
        Finding.of("scale bars not tested", names=["a-b"]),
        "Scale bars a-b hold the block and were not tested against it, since sigmas could not be computed; compare "
        "their lengths by other means, or mend what the sigmas lack.",
    ),
    (
        Finding.of("scale by bars", count=1),
        "1 scale bar told the scale of a block that has no place on earth: it is in metres.",
    ),
    (
        Finding.of("not settled", medians_px=[1.0, 0.8, 0.55]),
        "The median error still changed after 3 rounds (1.00, 0.80, 0.55 px); set adjust.max_rounds higher, or "
        "look at the edges and images named here.",
    ),
    (
        Finding.of("not converged", advice="look there."),
        "The last solve: look there.",
    ),
    (
        Finding.of("large median", median_px=4.25),
        "The median error is 4.2 px: check the focal length against the sensor's specification, and whether "
        "cameras or zooms are mixed.",
    ),
    (
        Finding.of("edges left out", names=["a, b"], matches=[60], median_px=[5.12], limit_px=3.0),
        "1 edge was left out, since its matches are off by over 3 px in the median. Look at its photos for "
        "repeated patterns or movement.\n     5.1 px     60 matches  a, b",
    ),
    (
        Finding.of(
            "edges left out",
            names=[f"p{i}, q{i}" for i in range(13)],
            matches=[1200] + [45] * 12,
            median_px=[812.0, *np.linspace(40, 3.1, 12).tolist()],
            limit_px=3.0,
        ),
        "13 edges were left out, since their matches are off by over 3 px in the median. Look at photos of the "
        "worst for repeated patterns or movement.\n"
        "   812.0 px   1200 matches  p0, q0\n"
        "    40.0 px     45 matches  p1, q1\n"
        "    36.6 px     45 matches  p2, q2\n"
        "    33.3 px     45 matches  p3, q3\n"
        "    29.9 px     45 matches  p4, q4\n"
        "    26.6 px     45 matches  p5, q5\n"
        "    23.2 px     45 matches  p6, q6\n"
        "    19.9 px     45 matches  p7, q7\n"
        "  and 5 more: summary.json, adjust.edges_left_out",
    ),
    (
        Finding.of("image lost", name="a", reason="off"),
        "Image lost in the adjustment: a: off.",
    ),
    (
        Finding.of("few points", names=["a", "b"], points=[7, 12], least=20),
        "2 images with fewer than 20 points, so weakly placed: a (7 points), b (12 points). More overlap or "
        "features cure it.",
    ),
    (
        Finding.of("few points", names=["a"], points=[7], least=20),
        "1 image with fewer than 20 points, so weakly placed: a (7 points). More overlap or features cure it.",
    ),
    (
        Finding.of("positions contradict", names=["a"], residual_m=[[-2.0, 0.04, NAN]], measured=12, sigmas=3.0),
        "1 measured position of 12 contradicts the photos by more than 3.0 robust sigmas and hardly counts (adjusted "
        "minus measured): a (east -2.0, north +0.0 m).",
    ),
    (
        Finding.of(
            "positions contradict", names=["a", "b"], residual_m=[[-2.0, 0.04, 9.0], [5.0] * 3], measured=12, sigmas=3.0
        ),
        "2 measured positions of 12 contradict the photos by more than 3.0 robust sigmas and hardly count (adjusted "
        "minus measured): a (east -2.0, north +0.0, up +9.0 m), b (east +5.0, north +5.0, up +5.0 m).",
    ),
    (
        Finding.of("positions scatter", axes=["east", "up"], scale_m=[0.2, 1.0], stated_m=[0.03, 0.06]),
        "Measured positions scatter more than their sigmas say (east 0.2 m instead of 0.03 m, up 1 m instead of "
        "0.06 m); the sigmas were enlarged to that. Check the antenna's offset, the time between exposure and "
        "fix, and whether the receiver had its fixed solution.",
    ),
    (
        Finding.of("heights drift", drift_m=80.04, share=0.97),
        "Measured heights drift against the photos by 80.0 m from the first to the last photo, which explains 97%"
        " of their residuals: the receiver's altitude cannot be trusted. Leave heights out, or use ground "
        "control.",
    ),
    (
        Finding.of("no heights"),
        "No measured height is used, so the block's height and its tilt are those of the start values and not "
        "measured: heights and slopes of the results are not to be relied on. Add ground control, or photos with "
        "heights that can be trusted.",
    ),
    (
        Finding.of(
            "focal and height",
            parameter="fx",
            focal_px=1000.0,
            std_px=30.0,
            height_m=50.0,
            looks="down",
            above_ground_m=46.0,
            above_take_off_m=40.0,
        ),
        "Focal length and height trade off (photos look straight down): fx is 1000.0 px with a sigma of 30.0 px "
        "(3.0%), which alone makes the height above ground of 50.0 m uncertain by 1.5 m. The cameras are 46.0 m "
        "above the ground points by the adjustment and 40.0 m above the take-off point by the flight's own record"
        " (+15%); a focal length of 870 px would agree with it, if the ground lies at the height of the take-off "
        "point. Hold the focal length at a calibrated value (metadata.focal), fly a second height, add oblique "
        "photos, or measure ground control.",
    ),
    (
        Finding.of("focal and height", parameter="f", focal_px=1000.0, std_px=30.0, height_m=50.0, looks="around"),
        "Focal length and height trade off: f is 1000.0 px with a sigma of 30.0 px (3.0%), which alone makes the "
        "height above ground of 50.0 m uncertain by 1.5 m. Hold the focal length at a calibrated value "
        "(metadata.focal), fly a second height, add oblique photos, or measure ground control.",
    ),
    (
        Finding.of(
            "focal and height",
            parameter="fx",
            focal_px=1000.0,
            std_px=NAN,
            height_m=50.0,
            looks="down from one height",
            above_ground_m=46.0,
            above_take_off_m=50.0,
        ),
        "Focal length and height trade off (all photos look straight down from one height): fx is 1000.0 px. The "
        "cameras are 46.0 m above the ground points by the adjustment and 50.0 m above the take-off point by the "
        "flight's own record (-8%); a focal length of 1087 px would agree with it, if the ground lies at the "
        "height of the take-off point. Hold the focal length at a calibrated value (metadata.focal), fly a second"
        " height, add oblique photos, or measure ground control.",
    ),
    (
        Finding.of("at bound", camera="DJI", parameter="k1", value=-0.5, low=-0.5, high=0.5),
        "Camera DJI: k1 is at its bound (-0.5, allowed -0.5 to 0.5): the calibration takes up another error. "
        "Check the focal length and the camera model, add oblique photos or control, or hold it fixed.",
    ),
    (
        Finding.of("focal moved", camera="DJI", parameter="fx", value=900.0, before=1000.0),
        "Camera DJI: fx moved from 1000 to 900 px (-10.0%). Compare with the sensor's specification.",
    ),
    (
        Finding.of("principal point off", camera="DJI", parameter="cx", value=660.0, middle=600.0),
        "Camera DJI: the principal point's cx is +60 px off the middle; in a block without cross strips it may "
        "stand for a tilt. Photos turned by 90 degrees tell.",
    ),
    (
        Finding.of("weak positions", names=[f"p{i}" for i in range(12)], std_m=[0.5] * 12, median_m=0.02),
        "12 images with a position sigma over five times the median of 0.02 m: p0 (0.5 m), p1 (0.5 m), p2 (0.5 "
        "m), p3 (0.5 m), p4 (0.5 m), p5 (0.5 m), p6 (0.5 m), p7 (0.5 m), p8 (0.5 m), p9 (0.5 m) and 2 more.",
    ),
    (
        Finding.of("common offset", median_m=0.02, axes=["east", "north", "up"], receiver_std_m=[3.0, 3.0, 5.0]),
        "Position sigmas (median 0.02 m) are those within the block, about the mean of all GNSS positions. Positions "
        "of a single receiver have an offset in common, up to their own sigma (east 3.0, north 3.0, up 5.0 m), which "
        "is not in these: only control or a differential receiver removes it.",
    ),
    (
        Finding.of("height datum assumed", of=["photos"], datum="unknown"),
        "Heights of the photos do not say what they are above: they are above an unknown surface, and so are the "
        "heights of all results. Ellipsoid and mean sea level lie up to 100 m apart. Declare it, by crs.height_datum "
        "for photos and control.height_datum for surveyed points.",
    ),
    (
        Finding.of("height datum assumed", of=["photos", "gcp_list.txt"], datum="ellipsoidal"),
        "Heights of the photos and gcp_list.txt do not say what they are above: they are taken to be above the WGS 84 "
        "ellipsoid, and so are the heights of all results. Ellipsoid and mean sea level lie up to 100 m apart. "
        "Declare it, by crs.height_datum for photos and control.height_datum for surveyed points.",
    ),
    (
        Finding.of(
            "attitudes contradict", names=["a.jpg", "b.jpg"], turn_deg=[178.4, 177.0], measured=18, quarter_turns=2
        ),
        "2 attitudes of 18 contradict the block by more than a gimbal or a compass errs, and hardly count in it: a.jpg "
        "(178 degrees), b.jpg (177 degrees). These are half a turn about the viewing direction, and the other photos "
        "are not turned: such pictures were turned after the flight, as image viewers do, which leave the gimbal's "
        "tags as they were. Give these photos as the camera wrote them. Attitudes also choose pairs and start values.",
    ),
    (
        Finding.of(
            "attitudes contradict", names=["a.jpg", "b.jpg"], turn_deg=[90.0, 91.0], measured=2, quarter_turns=1
        ),
        "2 attitudes of 2 contradict the block by more than a gimbal or a compass errs, and hardly count in it: a.jpg "
        "(90 degrees), b.jpg (91 degrees). All photos have a quarter turn about the viewing direction: the camera is "
        "mounted turned by it, or its yaw is counted from another side. Give attitudes in the list of positions that "
        "say how the pictures lie. Attitudes also choose pairs and start values.",
    ),
    (
        Finding.of("attitudes contradict", names=["a.jpg"], turn_deg=[61.0], measured=18, quarter_turns=0),
        "1 attitude of 18 contradicts the block by more than a gimbal or a compass errs, and hardly counts in it: "
        "a.jpg (61 degrees). They may be of the aircraft rather than of the camera, or in another convention of yaw, "
        "pitch and roll. Look at the tags, or give attitudes in the list of positions. Attitudes also choose pairs and "
        "start values.",
    ),
    (
        Finding.of("control without a place"),
        "The block has no place on earth, so that its control and check points cannot be compared with it.",
    ),
    (
        Finding.of("control not marked twice", names=["g1", "g2"], marks=[1, 0]),
        "Points that are not marked in two adjusted photos or more, and not used: g1 (1 mark), g2 (0 marks). Mark"
        " them in more photos.",
    ),
    (
        Finding.of("few control points", count=2, least=3, is_fit=True),
        "2 control points can be used where 3 are needed, so no fit was made. Mark more of them.",
    ),
    (
        Finding.of("few control points", count=2, least=3, is_fit=False),
        "2 control points can be used where 3 are needed, so they do not fix the block by themselves. Mark more "
        "of them.",
    ),
    (
        Finding.of("control on a line", count=4),
        "The 4 control points lie on a line, so that they do not hold the block from turning about it. Survey "
        "some to its sides.",
    ),
    (
        Finding.of("control horizontal only"),
        "Control is horizontal only and no position has a height, so the block's height and tilt are those of the"
        " start values (cameras look down on average): heights and slopes are not to be relied on. Survey the "
        "heights of three control points or more.",
    ),
    (
        Finding.of("marks contradict", marks=[["g1", "a.jpg"]], std_px=1.0),
        "Marks that contradict the others of their point by over 5 sigmas (control.mark_std_px=1), left out: g1 "
        "in a.jpg. Look at them.",
    ),
    (
        Finding.of("marks off", median_px=9.0, std_px=1.0),
        "Marks miss their points by 9.0 px in the median (sigma 1 px): were they set in photos of another size "
        "(control.mark_width_px), or counted from another corner?",
    ),
    (
        Finding.of("marks disagree", marks=2, name="g1", rms_px=8.0),
        "The 2 marks of g1 do not agree (RMS 8.0 px), and which is wrong cannot be told: look at them, or mark "
        "more photos.",
    ),
    (
        Finding.of(
            "control scatters", count=5, axes=["horizontally", "in height"], scatter_m=[0.5, 1.0], stated_m=[0.02, 0.03]
        ),
        "The 5 control points contradict the block, most of them and not one: they scatter by 0.5 m horizontally "
        "where their sigma is 0.02 m, 1 m in height where their sigma is 0.03 m. Their sigmas were enlarged to "
        "that. Compare how they were surveyed with control.std_h and control.std_v, and check their CRS, names "
        "and marks.",
    ),
    (
        Finding.of(
            "check points shifted", count=5, shift_m=[1.0, -0.8, 0.79], std_m=[0.02, 0.02, 0.06], is_controlled=False
        ),
        "All 5 check points are off alike: block minus survey east +1.000, north -0.800, up +0.790 m, where sigmas of "
        "east 0.02, north 0.02, up 0.06 m are expected. The block as a whole stands beside its place; its coordinates "
        "are not to be used before that is settled. A GNSS base beside its mark, another datum or height system, or "
        "the antenna's offset does that, and no sigma of a position holds it: correct the positions by it, or use "
        "three of the points as control.",
    ),
    (
        Finding.of(
            "check points shifted", count=3, shift_m=[0.0, 0.0, 0.4], std_m=[NAN, NAN, 0.06], is_controlled=True
        ),
        "All 3 check points are off alike: block minus survey east +0.000, north +0.000, up +0.400 m, where sigmas of "
        "up 0.06 m are expected. The block as a whole stands beside its place; its coordinates are not to be used "
        "before that is settled. Control and check points may be of two surveys or height systems: compare how both "
        "were measured.",
    ),
    (
        Finding.of(
            "control point set aside",
            name="g1",
            axes=[2],
            off_m=[NAN, NAN, -0.314],
            std_m=[NAN, NAN, 0.051],
            over_sigma=6.3,
            limit=3.29,
            rivals=[],
        ),
        "Control point g1 contradicts photos, positions and the other control points in height: they place it "
        "up -0.314 m from where it was surveyed (sigma up 0.051 m; 6.3 sigmas where 3.29 are exceeded by chance in one "
        "of a thousand). It does not hold the block in height. Check its coordinates, its name and its marks.",
    ),
    (
        Finding.of(
            "control point set aside",
            name="g1",
            axes=[0, 1],
            off_m=[0.3, 0.0, NAN],
            std_m=[0.02, 0.03, NAN],
            over_sigma=13.0,
            limit=3.29,
            rivals=["g2", "all positions in common"],
        ),
        "Control point g1 contradicts photos, positions and the other control points across: they place it "
        "east +0.300, north +0.000 m from where it was surveyed (sigma east 0.02, north 0.03 m; 13.0 sigmas where 3.29 "
        "are exceeded by chance in one of a thousand). It does not hold the block across. Check its coordinates, its "
        "name and its marks. g2 or all positions in common would explain it as well: which it is cannot be told.",
    ),
    (
        Finding.of("control labels exchanged", names=["g1", "g4"], apart_m=72.84, rivals=[]),
        "The labels of control points g1 and g4 are exchanged: each lies where the other was surveyed, 72.8 m away. "
        "Neither holds the block. Exchange their coordinates in the list, or the names at their marks.",
    ),
    (
        Finding.of(
            "do not use",
            reasons=[
                {"reason": "cannot tell", "names": ["g1", "all positions in common"]},
                {"reason": "check points shifted", "shift_m": [0.0, 0.0, 0.4]},
            ],
        ),
        "DO NOT USE this result: the contradiction may lie with g1 or all positions in common, and which cannot be "
        "told. Survey or mark one point more near them; the block stands east +0.000, north +0.000, up +0.400 m from "
        "where all check points say. Correct positions or control by it, whichever is wrong; then run again.",
    ),
    (
        Finding.of(
            "do not use",
            reasons=[
                {"reason": "most are wrong", "names": ["g1", "g2"]},
                {"reason": "survey scatters", "times": 10.0},
                {"reason": "not settled", "names": ["g1"]},
            ],
        ),
        "DO NOT USE this result: most of the control points contradict the block (g1, g2). Check the list's CRS, its "
        "heights, its names and marks; control points scatter by 10 times their sigmas or more: that is no survey of "
        "them. Check the list's CRS, its heights, its names and marks, or state what they are good to (control.std_h, "
        "control.std_v); which control points are wrong (g1?) depends on which hold the block. Look at all of them, "
        "and survey more; then run again.",
    ),
    (
        Finding.of(
            "control point contradicts",
            name="c1",
            is_check=True,
            residual_m=[0.5, -0.1, 2.0],
            over_sigma=9.0,
            limit=3.29,
            method="adjust",
        ),
        "Check point c1 contradicts the block: adjusted minus surveyed east +0.500, north -0.100, up +2.000 m, "
        "9.0 sigmas where 3.29 are exceeded by chance in one of a thousand. Check its coordinates, its name and "
        "its marks.",
    ),
    (
        Finding.of(
            "control point contradicts",
            name="g1",
            is_check=False,
            residual_m=[0.5, -0.1, 2.0],
            over_sigma=9.0,
            limit=3.29,
            method="helmert",
        ),
        "Control point g1 contradicts the block: adjusted minus surveyed east +0.500, north -0.100, up +2.000 "
        "m, 9.0 sigmas where 3.29 are exceeded by chance in one of a thousand. Check its coordinates, its name "
        "and its marks. It was left out of the fit where others remained.",
    ),
    (
        Finding.of(
            "control point contradicts",
            name="g1",
            is_check=False,
            residual_m=[0.5, -0.1, 2.0],
            over_sigma=9.0,
            limit=3.29,
            method="affine",
        ),
        "Control point g1 contradicts the block: adjusted minus surveyed east +0.500, north -0.100, up +2.000 "
        "m, 9.0 sigmas where 3.29 are exceeded by chance in one of a thousand. Check its coordinates, its name "
        "and its marks. It was left out of the fit where others remained.",
    ),
    (
        Finding.of(
            "control point contradicts",
            name="g1",
            is_check=False,
            residual_m=[0.5, -0.1, 2.0],
            over_sigma=9.0,
            limit=3.29,
            method="none",
        ),
        "Control point g1 contradicts the block: adjusted minus surveyed east +0.500, north -0.100, up +2.000 "
        "m, 9.0 sigmas where 3.29 are exceeded by chance in one of a thousand. Check its coordinates, its name "
        "and its marks.",
    ),
    (
        Finding.of(
            "gnss off control",
            offset_m=[1.5, -2.0, NAN],
            offset_std_m=[0.02, 0.02, NAN],
            std_m=[0.03, 0.03, 0.06],
            is_compared=False,
            looks_like="",
        ),
        "The block as control places it lies off its GNSS positions, all alike (adjusted minus measured): east -1.50, "
        "north +2.00 m (sigma east 0.02, north 0.02 m), where one position has sigmas of east 0.03, north 0.03 m; the "
        "block follows control. Centimetres and decimetres are the antenna's offset or a base beside its mark; metres "
        "and tens of metres two datums or height systems; hundreds a wrong zone or swapped axes of one of the two.",
    ),
    (
        Finding.of(
            "gnss off control",
            offset_m=[1.5, -2.0, 31.0],
            offset_std_m=[NAN, NAN, NAN],
            std_m=[3.0, 3.0, INF],
            is_compared=True,
            looks_like="feet as metres",
        ),
        "The block as control places it lies off its GNSS positions, all alike (adjusted minus measured): east -1.50, "
        "north +2.00, up -31.00 m, where one position has sigmas of east 3, north 3 m; compared only. Centimetres and "
        "decimetres are the antenna's offset or a base beside its mark; metres and tens of metres two datums or height "
        "systems; hundreds a wrong zone or swapped axes of one of the two. Heights of the list read feet as metres "
        "would make just this difference.",
    ),
]


@dataclass(frozen=True)
class Kept:
    findings: tuple[Finding, ...]


@pytest.mark.parametrize(("finding", "words"), CASES, ids=[finding.kind for finding, _ in CASES])
def test_a_finding_is_told_with_its_figures(finding: Finding, words: str):
    assert sentence(finding) == words


@pytest.mark.parametrize(("finding", "words"), CASES, ids=[finding.kind for finding, _ in CASES])
def test_what_is_not_known_is_left_out_of_a_sentence(finding: Finding, words: str):
    assert not re.search(r"\b(nan|inf|none|None)\b", sentence(finding))


def test_what_was_done_is_told_apart_from_what_asks_for_something():
    kinds = {finding.kind for finding, _ in CASES if not is_to_act_on(finding)}
    assert kinds == {"edges left out", "common offset", "scale by bars", "height datum assumed", "audit note"}


def test_more_than_ten_photos_are_counted():
    finding = next(finding for finding, _ in CASES if finding.kind == "weak positions")
    assert sentence(finding).endswith("p9 (0.5 m) and 2 more.")


def test_counts_of_a_sentence_are_written_alike():
    many = Finding.of("few points", names=["a"] * 1200, points=[7] * 1200, least=20)
    assert sentence(many).startswith("1,200 images with fewer than 20 points") and " and 1,190 more." in sentence(many)


def test_every_kind_that_can_be_found_has_words_and_a_case():
    folder = Path(jaxba.__file__).parent
    paths = [*(folder / "sfm").rglob("*findings.py"), folder / "audit" / "_faults.py"]
    sources = "".join(path.read_text() for path in paths)
    found = set(re.findall(r'Finding\.of\(\s*"([^"]+)"', sources))
    assert found == set(WORDS) == {finding.kind for finding, _ in CASES}


def test_findings_are_told_alike_after_they_were_stored(tmp_path: Path):
    save(tmp_path / "kept", Kept(tuple(finding for finding, _ in CASES)), Key("code", {}, {}))
    again = load(tmp_path / "kept", Kept).findings
    assert [sentence(finding) for finding in again] == [words for _, words in CASES]
