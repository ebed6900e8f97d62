"""Benchmarks: one command each; `benchmarks/README.md` has every table with its command, commit and machine."""
