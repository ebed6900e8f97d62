"""Diagnosis of a project: what looks poor, the likely cause with its figures, and the cure; a file a group of rules."""

from jaxba.report.diagnosis._diagnosis import Diagnosis
from jaxba.report.diagnosis._rules import RULES, diagnose, diagnoses

__all__ = ["RULES", "Diagnosis", "diagnose", "diagnoses"]
