"""Figures of a result."""

from jaxba.report._picture import Picture, draw_picture

__all__ = ["Picture", "draw_picture"]
