from ._audit import Audited as Audited, audit as audit
