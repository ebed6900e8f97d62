"""Control points, check points and scale bars in an adjustment: how they take part, are tested, and are told of."""
