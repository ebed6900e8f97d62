"""How well an adjustment knows its unknowns, and what measurements say of each other: covariances, tests, weights."""
