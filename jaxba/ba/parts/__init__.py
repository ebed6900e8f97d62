"""Parts: the points of a problem dealt out, so that each core works on its own part of a step."""
