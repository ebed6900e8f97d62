"""Sensors of cameras that fly: what turns a focal length in millimetres into pixels, and checks one that tags state.

Source: the makers' data sheets; where these give pixels and pixel pitch alone, the width is their product. Widths are
good to about 3%, which is enough to start from and to catch a wrong tag.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Sensor:
    """The part of a sensor that the largest photo uses.

    - `width_mm`: along the longer side. `width_px`, `height_px`: of the largest photo in the sensor's own format.
    - `focal_mm`: of a lens that cannot zoom or be changed; None otherwise.
    """

    width_mm: float
    width_px: int
    height_px: int
    focal_mm: float | None

    def pixels_per_mm(self, width_px: int | float, height_px: int | float) -> float:
        """Return the scale of a photo of this size, see `scale_of`."""
        return self.width_px / self.width_mm * scale_of(width_px, height_px, self.width_px, self.height_px)


def scale_of(
    width_px: int | float, height_px: int | float, original_width_px: int | float, original_height_px: int | float
) -> float:
    """Return the scale of a photo against its original, as one that was scaled, cropped to another format, or both.

    The cropped photo fills the original's width or height; a turned one is compared side by side.

    >>> scale_of(1600, 900, 4000, 3000), scale_of(900, 1600, 4000, 3000)  # 16:9 of a 4:3 sensor
    (0.4, 0.4)
    """
    long, short = max(width_px, height_px), min(width_px, height_px)
    original_long, original_short = (
        max(original_width_px, original_height_px),
        min(original_width_px, original_height_px),
    )
    by_long, by_short = long / original_long, short / original_short
    # sides are rounded to whole pixels: the longer one is the exacter measure of a scale without a crop
    return by_long if abs(short - by_long * original_short) <= 1 else max(by_long, by_short)


# fmt: off
_ROWS: tuple[tuple[str, float, int, int, float | None], ...] = (
    # DJI
    ("fc200", 6.17, 4384, 3288, 5.0), ("phantom vision fc200", 6.17, 4384, 3288, 5.0),
    ("fc300c", 6.2, 4000, 3000, 3.61), ("fc300s", 6.2, 4000, 3000, 3.61), ("fc300x", 6.2, 4000, 3000, 3.61),
    ("fc300se", 6.2, 4000, 3000, 3.61), ("fc330", 6.2, 4000, 3000, 3.61), ("fc350", 6.2, 4000, 3000, 3.61),
    ("fc220", 6.2, 4000, 3000, 4.73), ("fc1102", 6.17, 3968, 2976, 4.49), ("fc2103", 6.29, 4056, 3040, 4.5),
    ("fc2204", 6.2, 4000, 3000, None), ("fc3170", 6.4, 8000, 6000, 4.5), ("fc3411", 13.2, 5472, 3648, 8.4),
    ("fc7203", 6.2, 4000, 3000, 4.49), ("fc7303", 6.2, 4000, 3000, 4.49), ("fc3582", 9.7, 8064, 6048, 6.72),
    ("fc3682", 9.7, 8064, 6048, 6.72), ("fc8482", 9.7, 8064, 6048, 6.72), ("fc8282", 9.7, 8064, 6048, 6.72),
    ("fc6310", 13.2, 5472, 3648, 8.8), ("fc6310s", 13.2, 5472, 3648, 8.8), ("fc6310r", 13.2, 5472, 3648, 8.8),
    ("fc6360", 4.87, 1600, 1300, 5.74), ("fc6510", 13.2, 5472, 3648, 8.8), ("fc550", 17.3, 4608, 3456, None),
    ("fc550raw", 17.3, 4608, 3456, None), ("fc6520", 17.3, 5280, 3956, None), ("fc6540", 23.5, 6016, 4008, None),
    ("l1d-20c", 13.2, 5472, 3648, 10.26), ("l2d-20c", 17.3, 5280, 3956, 12.29), ("zenmusep1", 35.9, 8192, 5460, None),
    ("zenmusel1", 13.2, 5472, 3648, 8.8),
    # several lenses under one name: the one whose focal length is nearest
    ("m3e", 17.3, 5280, 3956, 12.29), ("m3e", 6.4, 8000, 6000, 29.8), ("m3t", 6.4, 8000, 6000, 4.4),
    ("m3t", 6.4, 8000, 6000, 29.8), ("m3t", 7.68, 640, 512, 9.1), ("m3m", 17.3, 5280, 3956, 12.29),
    ("m3m", 5.18, 2592, 1944, 4.34), ("sequoia", 4.8, 1280, 960, 3.98), ("sequoia", 6.17, 4608, 3456, 4.88),
    # senseFly, Parrot, Autel, MicaSense
    ("s.o.d.a.", 13.2, 5472, 3648, 10.6), ("aeria x", 23.5, 6000, 4000, 18.5), ("anafi", 5.93, 5344, 4016, 4.0),
    ("xt701", 6.4, 8000, 6000, 4.74), ("xt705", 13.2, 5472, 3648, 10.57), ("rededge", 4.8, 1280, 960, 5.5),
    ("rededge-m", 4.8, 1280, 960, 5.4), ("altum", 7.12, 2064, 1544, 8.0),
    # Canon
    ("powershot s90", 7.44, 3648, 2736, None), ("powershot s95", 7.44, 3648, 2736, None),
    ("powershot s100", 7.44, 4000, 3000, None), ("powershot s110", 7.44, 4000, 3000, None),
    ("powershot s40", 7.18, 2272, 1704, None), ("powershot sx230 hs", 6.17, 4000, 3000, None),
    ("powershot sx260 hs", 6.17, 4000, 3000, None), ("powershot elph 300 hs", 6.17, 4000, 3000, None),
    ("ixus 220 hs", 6.17, 4000, 3000, None), ("ixus 220hs", 6.17, 4000, 3000, None),
    ("powershot elph 110 hs", 6.17, 4608, 3456, None), ("ixus 127 hs", 6.17, 4608, 3456, None),
    ("powershot g9 x", 13.2, 5472, 3648, None), ("eos 30d", 22.5, 3504, 2336, None),
    ("eos digital rebel xsi", 22.2, 4272, 2848, None), ("eos 450d", 22.2, 4272, 2848, None),
    ("eos rebel t2i", 22.3, 5184, 3456, None), ("eos 550d", 22.3, 5184, 3456, None),
    ("eos m", 22.3, 5184, 3456, None), ("eos 5d mark ii", 36.0, 5616, 3744, None),
    ("eos 5d mark iii", 36.0, 5760, 3840, None), ("eos 6d", 35.8, 5472, 3648, None),
    ("eos 5ds r", 36.0, 8688, 5792, None),
    # Sony
    ("ilce-5000", 23.2, 5456, 3632, None), ("ilce-5100", 23.5, 6000, 4000, None), ("ilce-6000", 23.5, 6000, 4000, None),
    ("ilce-6300", 23.5, 6000, 4000, None), ("ilce-6500", 23.5, 6000, 4000, None), ("ilce-qx1", 23.2, 5456, 3632, None),
    ("nex-5n", 23.4, 4912, 3264, None), ("nex-5r", 23.4, 4912, 3264, None), ("nex-5t", 23.4, 4912, 3264, None),
    ("nex-7", 23.5, 6000, 4000, None), ("ilce-7", 35.8, 6000, 4000, None), ("ilce-7r", 35.9, 7360, 4912, None),
    ("ilce-7rm2", 35.9, 7952, 5304, None), ("ilce-7rm3", 35.9, 7952, 5304, None),
    ("ilce-7rm4", 35.7, 9504, 6336, None), ("dsc-rx1", 35.8, 6000, 4000, 35.0), ("dsc-rx1r", 35.8, 6000, 4000, 35.0),
    ("dsc-rx1rm2", 35.9, 7952, 5304, 35.0), ("dsc-rx100", 13.2, 5472, 3648, None),
    ("dsc-rx100m2", 13.2, 5472, 3648, None), ("dsc-wx220", 6.17, 4896, 3672, None),
    # others
    ("hero3+ black edition", 6.17, 4000, 3000, None), ("hero4 black", 6.17, 4000, 3000, None),
    ("hero4 silver", 6.17, 4000, 3000, None), ("hero5 black", 6.17, 4000, 3000, None),
    ("hero6 black", 6.17, 4000, 3000, None), ("hero7 black", 6.17, 4000, 3000, None),
    ("gr", 23.7, 4928, 3264, 18.3), ("gr ii", 23.7, 4928, 3264, 18.3), ("gr iii", 23.5, 6000, 4000, 18.3),
    ("dmc-gh4", 17.3, 4608, 3456, None), ("d800", 35.9, 7360, 4912, None), ("d810", 35.9, 7360, 4912, None),
    ("coolpix a", 23.6, 4928, 3264, 18.5), ("iphone 4s", 4.54, 3264, 2448, 4.28),
)
# fmt: on


def find_sensor(make: str, model: str, focal_mm: float | None = None) -> Sensor | None:
    """Return the sensor of a camera by the make and model in its tags, or None.

    Of several lenses under one name, `focal_mm` chooses the nearest; without it there is no answer.

    >>> find_sensor("Canon", "Canon EOS 5D Mark III")
    Sensor(width_mm=36.0, width_px=5760, height_px=3840, focal_mm=None)
    """
    name = " ".join(model.lower().split())
    for word in (*make.lower().split(), *make.lower().replace("corporation", "").split()):
        name = name.removeprefix(word).strip()
    rows = [Sensor(*row[1:]) for row in _ROWS if row[0] == name]
    if len(rows) <= 1:
        return rows[0] if rows else None
    if not focal_mm:
        return None
    return min(rows, key=lambda row: abs((row.focal_mm or 0.0) / focal_mm - 1))
