"""Files to types and back: `tile.npz` (all that a problem holds) and BAL text; files that appear whole or not at all.

`import jaxba.io` loads no jax, so that a program that only writes files stays light: the readers and writers of
problems load it when they are first used (PEP 562).
"""

from typing import TYPE_CHECKING

from jaxba._lazy import lazy
from jaxba.io._atomic import refuse_same_file, write_atomically

if TYPE_CHECKING:
    from jaxba.io._bal import read_bal, what_bal_cannot_hold, write_bal
    from jaxba.io._cloud import Cloud
    from jaxba.io._colmap import write_colmap_binary, write_colmap_text
    from jaxba.io._crs import CrsText
    from jaxba.io._csv_cloud import write_csv_cloud
    from jaxba.io._csv_control import ControlTable, write_csv_control
    from jaxba.io._gcp import ControlList, Mark, SurveyedPoint, parse_control
    from jaxba.io._geopackage import write_geojson, write_geopackage
    from jaxba.io._geotag_match import match_geotags, photo_finder
    from jaxba.io._geotags import Geotag, Geotags, parse_geotags
    from jaxba.io._las import write_las
    from jaxba.io._opensfm import write_opensfm
    from jaxba.io._ply import write_ply
    from jaxba.io._problem import read_problem
    from jaxba.io._read_colmap import ColmapModel, read_colmap_text
    from jaxba.io._schema import SCHEMA, schema_markdown
    from jaxba.io._sites import Sites, make_sites
    from jaxba.io._tile import read_tile, write_tile

__all__ = [
    "SCHEMA", "Cloud", "ColmapModel", "ControlList", "ControlTable", "CrsText", "Geotag", "Geotags", "Mark", "Sites",
    "SurveyedPoint", "make_sites", "match_geotags", "parse_control", "parse_geotags", "photo_finder", "read_bal",
    "read_colmap_text", "read_problem", "read_tile", "refuse_same_file", "schema_markdown", "what_bal_cannot_hold",
    "write_atomically", "write_bal", "write_colmap_binary", "write_colmap_text", "write_csv_cloud",
    "write_csv_control", "write_geojson", "write_geopackage", "write_las", "write_opensfm", "write_ply", "write_tile",
]  # fmt: skip

_MODULE_OF = {
    "SCHEMA": "jaxba.io._schema",
    "Cloud": "jaxba.io._cloud",
    "ColmapModel": "jaxba.io._read_colmap",
    "ControlList": "jaxba.io._gcp",
    "ControlTable": "jaxba.io._csv_control",
    "CrsText": "jaxba.io._crs",
    "Geotag": "jaxba.io._geotags",
    "Geotags": "jaxba.io._geotags",
    "Mark": "jaxba.io._gcp",
    "Sites": "jaxba.io._sites",
    "SurveyedPoint": "jaxba.io._gcp",
    "make_sites": "jaxba.io._sites",
    "match_geotags": "jaxba.io._geotag_match",
    "parse_control": "jaxba.io._gcp",
    "parse_geotags": "jaxba.io._geotags",
    "photo_finder": "jaxba.io._geotag_match",
    "read_bal": "jaxba.io._bal",
    "read_colmap_text": "jaxba.io._read_colmap",
    "read_problem": "jaxba.io._problem",
    "read_tile": "jaxba.io._tile",
    "schema_markdown": "jaxba.io._schema",
    "what_bal_cannot_hold": "jaxba.io._bal",
    "write_bal": "jaxba.io._bal",
    "write_colmap_binary": "jaxba.io._colmap",
    "write_colmap_text": "jaxba.io._colmap",
    "write_csv_cloud": "jaxba.io._csv_cloud",
    "write_csv_control": "jaxba.io._csv_control",
    "write_geojson": "jaxba.io._geopackage",
    "write_geopackage": "jaxba.io._geopackage",
    "write_las": "jaxba.io._las",
    "write_opensfm": "jaxba.io._opensfm",
    "write_ply": "jaxba.io._ply",
    "write_tile": "jaxba.io._tile",
}

__getattr__, __dir__ = lazy(__name__, _MODULE_OF)
