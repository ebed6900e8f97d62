from . import diagnosis as diagnosis, verification as verification
from ._picture import Picture as Picture, draw_picture as draw_picture
from ._recorded import Recorded as Recorded, recorded as recorded
from ._status import Status as Status, project_settings as project_settings, status as status
from ._summary import stage_lines as stage_lines, summary as summary
