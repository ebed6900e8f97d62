from ._fingerprint import code_version as code_version, fingerprint as fingerprint
from ._key import Key as Key
from ._lock import holder as holder, locked as locked
from ._parameters import Parameters as Parameters, parameter as parameter
from ._project import Given as Given, Project as Project
from ._settings import (
    Settings as Settings,
    changed as changed,
    explained as explained,
    from_toml as from_toml,
    set_from_tables as set_from_tables,
    to_toml as to_toml,
)
from ._stage import Item as Item, Pipeline as Pipeline, Stage as Stage
from ._workers import Resources as Resources
