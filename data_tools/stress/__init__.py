"""Stress test: how far each known failure of such methods goes, as sweeps with a pass line.

A row (`data_tools.stress.rows`) is one failure: a sweep of trials, the score that is drawn, and a pass line. A trial is
one run of a procedure (`data_tools.stress.procedures`); its result is a file that is keyed by everything that
determines it, so an interrupted sweep continues. `python -m data_tools.stress` runs rows, judges them, and writes
`stress.csv`, `stress.png` and the tables of `docs/stress.md`.
"""
