"""Verification of a project's exports, read anew from the disk: files and form, numbers, errors, CRS and place."""

from jaxba.report.verification._check import Check
from jaxba.report.verification.verify import Params, exported_findings, verify

__all__ = ["Check", "Params", "exported_findings", "verify"]
