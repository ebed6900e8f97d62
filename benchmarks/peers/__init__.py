"""Other solvers of the same problem, each behind one function that returns a `Record`."""
