from ._facts import facts_of as facts_of, report_facts as report_facts
from ._material import Material as Material, projected as projected
from ._schema import FIELDS as FIELDS, paths_of as paths_of, schema_markdown as schema_markdown
from ._survey import place as place
from ._write import write_facts as write_facts, write_report as write_report
