from ._bal import (
    read_bal as read_bal,
    what_bal_cannot_hold as what_bal_cannot_hold,
    write_bal as write_bal,
)
from ._bars import BAR_COLUMNS as BAR_COLUMNS, MeasuredBar as MeasuredBar, parse_bars as parse_bars
from ._cloud import Cloud as Cloud
from ._crs import CrsText as CrsText
from ._csv_bars import (
    BAR_RESULT_COLUMNS as BAR_RESULT_COLUMNS,
    bars_frame as bars_frame,
    write_csv_bars as write_csv_bars,
)
from ._csv_cloud import (
    CLOUD_COLUMNS as CLOUD_COLUMNS,
    cloud_frame as cloud_frame,
    write_csv_cloud as write_csv_cloud,
)
from ._csv_control import (
    CONTROL_COLUMNS as CONTROL_COLUMNS,
    ControlTable as ControlTable,
    control_frame as control_frame,
    write_csv_control as write_csv_control,
)
from ._gcp import (
    ControlList as ControlList,
    Mark as Mark,
    SurveyedPoint as SurveyedPoint,
    is_check_label as is_check_label,
    parse_control as parse_control,
)
from ._geopackage import write_geojson as write_geojson, write_geopackage as write_geopackage
from ._geotag_match import (
    like_photo as like_photo,
    match_geotags as match_geotags,
    photo_finder as photo_finder,
    photo_names as photo_names,
)
from ._geotags import Geotag as Geotag, Geotags as Geotags, parse_geotags as parse_geotags
from ._las import write_las as write_las
from ._list_cells import without_fillers as without_fillers
from ._ply import write_ply as write_ply
from ._problem import problem_of_bytes as problem_of_bytes, read_problem as read_problem
from ._read import read_bytes as read_bytes, text_of as text_of
from ._schema import SCHEMA as SCHEMA, schema_markdown as schema_markdown
from ._sites import (
    SITE_COLUMNS as SITE_COLUMNS,
    Sites as Sites,
    make_sites as make_sites,
    omega_phi_kappa_deg as omega_phi_kappa_deg,
)
from ._tile import Contents as Contents, read_loss as read_loss, read_tile as read_tile, write_tile as write_tile
from ._tiles import (
    TileFile as TileFile,
    fingerprint_of as fingerprint_of,
    place_of as place_of,
    read_block_tile as read_block_tile,
    read_tiles as read_tiles,
    solved_before as solved_before,
    write_tiles as write_tiles,
)
from .models._colmap import (
    write_colmap_binary as write_colmap_binary,
    write_colmap_text as write_colmap_text,
)
from .models._colmap_model import ColmapModel as ColmapModel
from .models._opensfm import write_opensfm as write_opensfm
from .models._read_colmap import read_colmap as read_colmap, read_colmap_text as read_colmap_text
from .models._read_colmap_binary import read_colmap_binary as read_colmap_binary
from .models._read_opensfm import read_opensfm as read_opensfm
from .models._reconstruction import read_reconstruction as read_reconstruction
