"""The health of Hall sensors: where their edges lie, what is wrong with them or their wires, in words with numbers.

`source` has a drive turn its motor (`turning`), somebody turn it (`passive`), or a recording read (`trace`). What that
means is said by `bench.findings.health`, `report` shows it, and `learn` hands the edges to the drive.
Tables that other tools made are read by `tables`, judged by `table_reading` and shown by `table_report`.
"""
