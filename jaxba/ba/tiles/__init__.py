"""Tiles: many problems at once, and one block cut into parts: exact adjustment part by part in bounded memory."""
