from . import photos as photos, synthetic as synthetic
from ._flight import (
    Images as Images,
    Terrain as Terrain,
    Tracks as Tracks,
    field_of_view as field_of_view,
    flight_plan as flight_plan,
    make_tracks as make_tracks,
    smooth_terrain as smooth_terrain,
)
from ._ground import Ground as Ground, paint_ground as paint_ground
from ._render import (
    expose as expose,
    ground_points as ground_points,
    pixel_rays as pixel_rays,
    render as render,
)
from ._survey import survey_frame as survey_frame
from ._write_photo import PhotoTags as PhotoTags, jpeg_with_tags as jpeg_with_tags
from .synthetic import DRONE_CAMERA as DRONE_CAMERA, Survey as Survey, Truth as Truth, uav_block as uav_block
