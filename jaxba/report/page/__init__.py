"""The page of a report: HTML made of `report.json` alone, with its figures, tables and look."""

from jaxba.report.page._page import page

__all__ = ["page"]
