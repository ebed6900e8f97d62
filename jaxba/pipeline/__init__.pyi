from ._events import Event as Event, Run as Run
from ._runner import run_pipeline as run_pipeline
from ._settings import (
    Settings as Settings,
    changed as changed,
    default_settings as default_settings,
    explained as explained,
    from_toml as from_toml,
    to_toml as to_toml,
)
from ._stages import NAMES as NAMES, STAGES as STAGES
