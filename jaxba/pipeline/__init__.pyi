from ._done import Done as Done
from ._events import Event as Event, Run as Run
from ._runner import run_pipeline as run_pipeline
from ._settings import (
    Settings as Settings,
    changed as changed,
    explained as explained,
    from_toml as from_toml,
    to_toml as to_toml,
)
from ._stages import (
    NAMES as NAMES,
    PIPELINE as PIPELINE,
    STAGES as STAGES,
    default_settings as default_settings,
)
from ._tiles import Tiles as Tiles
