from . import diagnosis as diagnosis, verification as verification
from ._accuracy import Accuracy as Accuracy, accuracy as accuracy, accuracy_row as accuracy_row
from ._bars import bar_facts as bar_facts, bar_rows as bar_rows
from ._control import control_facts as control_facts, control_lines as control_lines, control_rows as control_rows
from ._control_findings import CONTROL_KINDS as CONTROL_KINDS
from ._findings import is_to_act_on as is_to_act_on, sentence as sentence, sentences as sentences
from ._pairs import pair_facts as pair_facts, pair_lines as pair_lines
from ._picture import Picture as Picture, draw_picture as draw_picture
from ._reasons import grouped as grouped, with_ranges as with_ranges
from ._recorded import Recorded as Recorded, recorded as recorded
from ._reference import (
    flight_facts as flight_facts,
    flight_lines as flight_lines,
    reference_facts as reference_facts,
)
from ._statistics import statistics_facts as statistics_facts, statistics_rows as statistics_rows
from ._status import Status as Status, project_settings as project_settings, status as status
from ._summary import summary as summary, told_of as told_of
from ._tiles_picture import draw_tiles as draw_tiles
from ._told import Told as Told
