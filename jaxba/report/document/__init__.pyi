from ._facts import report_facts as report_facts
from ._schema import FIELDS as FIELDS, paths_of as paths_of, schema_markdown as schema_markdown
from ._write import write_report as write_report
